"""Hide effects in robots, diagnose every robot from its logs alone, and count how often the names are right.

The work is done by `op3.apps.hidden_effects`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("hidden_effects")
