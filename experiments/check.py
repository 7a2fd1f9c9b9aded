"""Check a robot file: its joints, what of its model acts, and a picture of it at home.

The work is done by `op3.apps.check`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("check")
