"""One page for several runs of identify.py: losses, held-out errors, parameters with their spread over seeds, time.

python experiments/compare_runs.py runs=outputs/identify/<multirun>
"""

from pathlib import Path

import hydra
from omegaconf import DictConfig
from support import check_given, one_sentence

from op3.command_line import launch
from op3.report import finish
from op3.report.comparison_page import read_runs, write_comparison


@hydra.main(config_path="../conf", config_name="compare_runs", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Read the runs and write the comparison into their folder."""
    with one_sentence(cfg=cfg):
        check_given(cfg, "runs", "folder of a multirun of identify.py")
        folder = Path(cfg.runs)
        finish(*write_comparison(read_runs(folder), folder))


if __name__ == "__main__":
    launch(main, "compare_runs", __doc__)
