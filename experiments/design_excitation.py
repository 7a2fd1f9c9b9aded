"""Choose the motions that narrow the intervals of parameters most per second of robot time.

The work is done by `op3.apps.design_excitation`; `--help` lists the settings.
"""

from op3.command_line import launch

if __name__ == "__main__":
    launch("design_excitation")
