"""The command `op3.apps.hidden_effects`; `--help` lists its settings."""

from op3.command_line import launch

if __name__ == "__main__":
    launch("hidden_effects")
