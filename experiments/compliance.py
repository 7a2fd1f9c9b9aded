"""Measure how soft policies are: gains over the gait, joints that are turned, landings, pushes, pulls, heat.

python experiments/compliance.py policy=<bundle>
python experiments/compliance.py policy=<bundle>,<trained with a fixed gain>
python experiments/compliance.py policy=<bundle> 'sizes={episodes: 8, push_episodes: 1}' grounds=[walk]
"""

import re
import sys
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from support import check_given, one_sentence, plain

from op3.command_line import launch
from op3.compliance.compare import difference
from op3.compliance.study import Sizes, Study, contestants
from op3.envs.actors import find_actor
from op3.report import RunFolder, run_provenance
from op3.report.compliance import report_compliance
from op3.sim import load_model


def names(value: Any) -> list[str]:
    """Policies of a list, or of a text with commas."""
    given = value.split(",") if isinstance(value, str) else value
    if not (isinstance(given, list) and given and all(isinstance(name, str) and name for name in given)):
        raise ValueError(f"policy must be a folder or several, got {value!r}")
    return given


def run(cfg: DictConfig) -> dict[str, Any]:
    """Measure all policies and report."""
    torch.set_num_threads(1)
    check_given(cfg, "policy", "folder of a bundle")
    options = {"gain_scale": cfg.gain_scale, "num_threads": cfg.threads}
    model, sizes = load_model(cfg.model), Sizes(**plain(cfg.sizes))
    study = Study(model, plain(cfg.grounds), sizes, cfg.seed, **options)
    asked = names(plain(cfg.policy))
    asked += [cfg.baseline] if cfg.baseline is not None and cfg.baseline not in asked else []
    if cfg.baseline is not None:
        find_actor(cfg.baseline, study.task, field="baseline")
    actors = contestants(asked, study.task, plain(cfg.fixed_gains), cfg.gain_scale)
    standing = {Path(name).name: study.stand(name) for name in plain(cfg.standing)}
    measured = [study.measure(actor, led=cfg.led) for actor in actors]
    landings = study.stiff_landings() if any(actor.stiff for actor in actors[1:]) else None
    differences = {
        other.label: difference(measured[0], other, landings if actor.stiff else None)
        for actor, other in zip(actors[1:], measured[1:], strict=True)
    }
    folder = Path(HydraConfig.get().runtime.output_dir)
    settings = {"policies": asked, "model": cfg.model, "sizes": plain(cfg.sizes), "gain_scale": cfg.gain_scale}
    provenance = {**run_provenance(seed=cfg.seed), **settings}
    return report_compliance(measured, differences, standing, RunFolder(folder, provenance))


@hydra.main(config_path="../conf", config_name="compliance", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Measure and report."""
    with one_sentence("Nothing is kept but what the folder holds.", cfg):
        run(cfg)


if __name__ == "__main__":
    if not {"-m", "--multirun"} & set(sys.argv):  # Hydra takes commas for a sweep; here they make a list
        sys.argv = [re.sub(r"^policy=([^\[\]'\"]*,[^\[\]'\"]*)$", r"policy=[\1]", argument) for argument in sys.argv]
    launch(main, "compliance", __doc__)
