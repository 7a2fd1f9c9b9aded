"""The command `op3.apps.compare_runs`; `--help` lists its settings."""

from op3.command_line import launch

if __name__ == "__main__":
    launch("compare_runs")
