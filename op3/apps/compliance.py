"""Measure how compliant policies are: gains, back-driven joints, landings, pushes, guidance by hand and heat.

op3 compliance policy=<bundle>
op3 compliance policy=[<bundle>,<trained with a fixed gain>]
op3 compliance policy=<bundle> 'sizes={episodes: 8, push_episodes: 1}' grounds=[walk]
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder, provenance, reported
from op3.apps.fields import plain
from op3.compliance.compare import difference
from op3.compliance.compliance_study import Sizes, Study, contestants
from op3.envs.actors import find_actor
from op3.report import RunFolder
from op3.report.compliance_page import report_compliance
from op3.sim import load_model

INTERRUPTED = "Only results already in the folder are kept."


def compliance(
    policy: str | Path | Sequence[str | Path],
    *,
    model: str | Path | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    overrides: Sequence[str] = (),
) -> CommandResult:
    """Measure how compliant policies are: gains, back-driven joints, landings, pushes, guidance by hand and heat.

    Args:
        policy: folder of one bundle or of several; the first is compared with the others.
        model: path of a ``model.yaml`` or a name in ``assets/models``; None: that of the config.
        seed: seed of the episodes.
        folder: folder of the run; None: a temporary folder.
        overrides: Hydra overrides of further settings in ``conf/compliance.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("compliance", **locals()) as cfg:
        return main(cfg)


def names(value: Any) -> list[str]:
    """The policies as a list, given one or a list."""
    given = [value] if isinstance(value, str) else value
    if not (isinstance(given, list) and given and all(isinstance(name, str) and name for name in given)):
        raise ValueError(f"policy must be one folder or a list of folders, got {value!r}")
    return given


def main(cfg: DictConfig) -> CommandResult:
    """Measure all policies and write the report."""
    torch.set_num_threads(1)
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
    settings = {"policies": asked, "model": cfg.model, "sizes": plain(cfg.sizes), "gain_scale": cfg.gain_scale}
    facts = {**provenance(cfg), **settings}
    values = report_compliance(measured, differences, standing, RunFolder(output_folder(), facts))
    return reported(CommandResult, values)
