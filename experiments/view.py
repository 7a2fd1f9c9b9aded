"""Look at a log, a policy, a model or a diagnosis: the robot solid, simulations as its ghosts, plots beside them.

The work is done by `op3.apps.view`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("view")
