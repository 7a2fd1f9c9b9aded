"""Identify a robot's or a servo's parameters from logs.

The work is done by `op3.apps.identify`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("identify")
