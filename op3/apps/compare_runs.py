"""Compare the runs of a multirun of `op3 identify` on one page: losses, errors, parameters, time.

op3 compare runs=outputs/identify/<multirun>
"""

from pathlib import Path

from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.report.comparison_page import read_runs, variants, write_comparison


def main(cfg: DictConfig) -> CommandResult:
    """Read the runs and write the comparison into their folder."""
    folder = Path(cfg.runs)
    runs = read_runs(folder)
    kinds = variants(runs)
    headline = f"{len(runs)} runs of {len(kinds)} variant{'s' * (len(kinds) != 1)}: {'; '.join(kinds)}."
    return CommandResult(folder, headline, files=tuple(write_comparison(runs, folder)))
