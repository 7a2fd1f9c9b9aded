"""Check a log of any format: its content, what was guessed and why, and what is wrong.

The work is done by `op3.apps.import_log`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("import_log")
