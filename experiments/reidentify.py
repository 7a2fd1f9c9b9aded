"""Re-identify a robot from a failed transfer by matching the returns of its episodes.

The work is done by `op3.apps.reidentify`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("reidentify")
