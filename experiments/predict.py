"""Measure how well a model predicts logs that it has not seen, with 90 % intervals.

The work is done by `op3.apps.predict`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("predict")
