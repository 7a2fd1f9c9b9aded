"""The command `op3.apps.deploy`; `--help` lists its settings."""

from op3.command_line import launch

if __name__ == "__main__":
    launch("deploy")
