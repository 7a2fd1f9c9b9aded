"""One page for several runs of identify.py: losses, held-out errors, parameters with their spread over seeds, time.

The work is done by `op3.apps.compare_runs`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("compare_runs")
