"""Hide an effect in a simulated robot, record the robot, and let the diagnosis name it: two minutes.

The work is done by `op3.apps.demo_diagnose`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("demo_diagnose")
