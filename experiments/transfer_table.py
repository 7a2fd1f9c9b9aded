"""Measure how often policies transfer, by what they were trained on: the paper's Tables III and IV.

The work is done by `op3.apps.transfer_table`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("transfer_table")
