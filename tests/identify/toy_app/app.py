"""A small experiment: find the bottom of a bowl. Run by the sweeper's tests as a real Hydra program."""

import os
import time
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig

from op3.identify.registration import register
from op3.identify.study import TrialOutcome
from op3.identify.sweeper import sweep_or_report

register()


def bowl(parameters):
    """Return the bowl's height above its bottom at (0.3, ..., 0.3)."""
    return TrialOutcome((sum((value - 0.3) ** 2 for value in parameters.values()),), {"pid": os.getpid()})


@hydra.main(config_path="conf", config_name="config", version_base="1.3")
def main(cfg):
    """Evaluate, or run and report."""
    if cfg.fail == "start":
        raise RuntimeError("there is no bowl")

    def evaluate(population):
        time.sleep(cfg.seconds)
        return [bowl(parameters) for parameters in population]

    def report(study):
        folder = Path(HydraConfig.get().runtime.output_dir)
        (folder / "report.txt").write_text(f"{study.study_name} {len(study.trials)}\n")
        return len(study.trials)

    def propose(count):
        keys = sorted(HydraConfig.get().sweeper.params)
        return [{key: 0.5 + 0.01 * number for key in keys} for number in range(count)]

    return sweep_or_report(cfg, evaluate, report, propose)


if __name__ == "__main__":
    main()
