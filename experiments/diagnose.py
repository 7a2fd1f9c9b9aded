"""Name the effects that a model does not include, from logs of a stand or of a servo bench.

The work is done by `op3.apps.diagnose`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("diagnose")
