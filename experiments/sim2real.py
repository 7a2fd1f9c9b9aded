"""Run the whole method against a robot: collect, identify, train, deploy, judge, learn from failures.

The work is done by `op3.apps.sim2real`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("sim2real")
