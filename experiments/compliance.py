"""Measure how compliant policies are: gains, back-driven joints, landings, pushes, pulls, heat.

The work is done by `op3.apps.compliance`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("compliance")
