"""An emulated robot on a serial port: prints the port, and serves until Ctrl-C or another signal to end.

The work is done by `op3.apps.emulate_robot`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("emulate_robot")
