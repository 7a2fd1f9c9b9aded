"""Judge a policy, or a baseline, under R_eval on a simulated robot.

The work is done by `op3.apps.evaluate`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("evaluate")
