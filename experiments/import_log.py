"""Look at a log of any format: what is in it, what was guessed and why, and what is wrong with it.

The work is done by `op3.apps.import_log`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("import_log")
