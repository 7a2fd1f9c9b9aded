"""Record a motion, a plan of motions or a policy on a robot, once or several times.

The work is done by `op3.apps.collect`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("collect")
