"""The paper's tables III and IV: how often policies transfer, by what they were trained on.

python experiments/transfer_table.py                                    # balancing: all robots, conditions and seeds
python experiments/transfer_table.py task=walk condition=excitation_only,reidentified,domain_randomisation
python experiments/transfer_table.py world=robot_7 seed=0               # a part of it; the page has all that is done

A multirun of sim2real.py whose cells share what they ask alike. The same command goes on after an interruption, and
several may work on the same folder.
"""

import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from sim2real import check, loop
from support import one_sentence

from op3.command_line import launch
from op3.report import finish
from op3.report.transfer_table_page import FAILED, read_cells, write_table
from op3.rollout.files import write_text

OmegaConf.register_new_resolver("stem", lambda path: Path(path).stem, replace=True)


@hydra.main(config_path="../conf", config_name="transfer_table", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Run one cell and write the table anew; a cell that cannot be run leaves the others."""
    with one_sentence("The same command goes on from the stages done.", cfg):
        check(cfg)
        folder = Path(HydraConfig.get().runtime.output_dir).absolute()
        (folder / FAILED).unlink(missing_ok=True)
        try:
            loop(cfg, folder)
        except ValueError as error:
            write_text(folder / FAILED, f"{error}\n")
            print(f"{folder.name}: {error}", file=sys.stderr)
        cells = read_cells(folder.parent)
        if cells:
            finish(*write_table(cells, folder.parent))


if __name__ == "__main__":
    launch(main, "transfer_table", __doc__)
