"""The command `op3.apps.import_log`; `--help` lists its settings."""

from op3.command_line import launch

if __name__ == "__main__":
    launch("import_log")
