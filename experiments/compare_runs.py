"""Compare the runs of a multirun of `op3 identify` on one page: losses, errors, parameters, time.

The work is done by `op3.apps.compare_runs`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("compare_runs")
