"""Run a policy on a robot, with start checks and limits; the exit code states how it ended.

The work is done by `op3.apps.deploy`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("deploy")
