"""Serve an emulated robot on a serial port until Ctrl-C; the first line printed is the port.

The work is done by `op3.apps.emulate_robot`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("emulate_robot")
