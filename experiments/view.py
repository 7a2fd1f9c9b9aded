"""Show a log, a policy, a model or a diagnosis: in a viewer, or as a film.

The work is done by `op3.apps.view`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("view")
