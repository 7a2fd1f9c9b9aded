"""Write a model for another simulator, with the error of what that cannot express.

The work is done by `op3.apps.export`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("export")
