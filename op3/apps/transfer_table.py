"""Count successful transfers for every training method, as in the paper's Tables III and IV.

op3 transfers                                    # balancing: all robots, conditions and seeds
op3 transfers task=walk condition=excitation_only,reidentified,domain_randomisation
op3 transfers world=robot_7 seed=0               # one transfer; the page shows all finished ones

The cells of this multirun of op3 sim2real share stages with equal arguments. The same command continues after an
interruption, and several processes may share the folder.
"""

import sys

from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.current_run import output_folder
from op3.apps.sim2real import check, loop
from op3.common.writing import write_text
from op3.deploy.exit_codes import Stop
from op3.report.transfer_table_page import FAILED, read_cells, write_table

INTERRUPTED = "The same command continues after the finished stages."


def main(cfg: DictConfig) -> CommandResult | None:
    """Run one cell and rewrite the table; a cell that fails does not stop the others."""
    check(cfg)
    folder = output_folder().absolute()
    (folder / FAILED).unlink(missing_ok=True)
    try:
        loop(cfg, folder)
    except (ValueError, Stop) as error:
        write_text(folder / FAILED, f"{error}\n")
        print(f"{folder.name}: {error}", file=sys.stderr)
    cells = read_cells(folder.parent)
    if not cells:
        return None
    succeeded = sum(bool(cell["success"]) for cell in cells)
    files = tuple(write_table(cells, folder.parent))
    return CommandResult(folder.parent, f"{succeeded} of {len(cells)} transfers succeed.", files=files)
