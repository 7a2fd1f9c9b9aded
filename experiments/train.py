"""Train a policy on a simulated robot.

The work is done by `op3.apps.train`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("train")
