"""Identify a robot's or a servo's parameters from logs.

op3 identify data=<log> [heldout=<log>] [groups=[motor,gear,friction,body]] [method=tpe]
op3 identify -m data=<log> seed=0,1,2 hydra.sweeper.n_trials=2000
op3 identify experiment=servo_bench data=<folder of bench logs>
"""

import dataclasses
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import optuna
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder, reported
from op3.apps.fields import plain
from op3.apps.job import goes_on
from op3.apps.support import focus_joints, logs_where, run_folder
from op3.identify.identification import PREFIX, Fit, Identification, Refine
from op3.identify.loss import UNIT_WEIGHTS, TrajectoryLoss
from op3.identify.resolvers import chosen_model
from op3.identify.study import run_study
from op3.identify.study_settings import read_settings, search_space_of
from op3.identify.sweeper import sweep_or_report
from op3.report.identification_page import report_identification
from op3.rollout import Rollout, read_logs
from op3.servo import RobotModel, effect_class
from op3.servo.conditions import split_name
from op3.sim import save_model

INTERRUPTED = goes_on("trials")


@dataclass(frozen=True, kw_only=True)
class Identified(CommandResult):
    """A model whose parameters were identified.

    Attributes:
        model: model with values and 90 % intervals, also stored as ``model.yaml``.
    """

    model: RobotModel


def identify(
    data: str | Path | Sequence[str | Path],
    *,
    heldout: str | Path | Sequence[str | Path] | None = None,
    model: str | Path | None = None,
    robot: str | Path | None = None,
    groups: Sequence[str] | None = None,
    effects: Sequence[str] = (),
    method: str | None = None,
    ablate: Sequence[str] | None = None,
    trials: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    wandb: str = "disabled",
    overrides: Sequence[str] = (),
) -> Identified:
    """Identify a model's parameters from logs.

    Args:
        data: logs to fit: a path, a folder, a pattern or a list of them.
        heldout: logs to test on, never used for fitting.
        model: path of a ``model.yaml`` or a name in ``assets/models`` to start from; None: the robot's own.
        robot: robot of the logs; None: as in the logs.
        groups: parameter groups to search; None: ``motor, gear, friction, body``.
        effects: effects of the catalogue to switch on in addition.
        method: ``tpe``, ``lsq``, ``cmaes`` or ``tpe+lsq``; None: ``tpe``.
        ablate: effects to switch off for comparison; None: ``dte``.
        trials: number of trials; None: the default of the method.
        seed: seed of all random numbers.
        folder: folder of the run, where an interrupted run continues; None: a temporary folder.
        wandb: ``offline``, ``online`` or ``disabled``.
        overrides: Hydra overrides of further settings in ``conf/identify.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("identify", **locals()) as cfg:
        return main(cfg)


def split_logs(cfg: DictConfig) -> tuple[list[Rollout], list[Rollout]]:
    """The fitted logs and the held-out logs, selected by file or by a metadata field."""
    logs = read_logs(plain(cfg.data), cfg.robot)
    heldout = [] if cfg.heldout is None else read_logs(plain(cfg.heldout), cfg.robot)
    # overrides extend a mapping, so null removes a field set by the experiment
    where = {key: value for key, value in (plain(cfg.heldout_where) or {}).items() if value is not None}
    chosen = logs_where(logs, where, "heldout_where") if where else []
    fitted = [log for log in logs if not any(log is held for held in chosen)]
    if not fitted:
        raise ValueError(f"heldout_where={where} matches all {len(logs)} logs; nothing is left to fit")
    return fitted, [*heldout, *chosen]


def build(cfg: DictConfig, model: RobotModel, label: str) -> Identification:
    """The identification that the config describes, for this model."""
    fit_logs, heldout_logs = split_logs(cfg)
    # a parameter is not searched if its range is null or its effect was switched off for comparison
    space, lost = search_space_of(plain(HydraConfig.get().sweeper)), gone(cfg, model)
    names = [key.removeprefix(PREFIX) for key in space]
    names = [name for name in names if split_name(name)[0] not in lost]
    joints = focus_joints(plain(cfg.joints), fit_logs)
    weights = UNIT_WEIGHTS if cfg.weights is None else {tuple(k.split("/")): v for k, v in cfg.weights.items()}
    loss = TrajectoryLoss(joints, weights, cfg.robust_scale, cfg.skip)
    return Identification(
        model, fit_logs, heldout_logs, names, joints=joints, loss=loss, label=label, bench_timestep=cfg.bench_timestep
    )


def base_model(cfg: DictConfig) -> RobotModel:
    """The initial model of the config: a model file with further effects switched on."""
    model = chosen_model(cfg)
    for name, options in plain(cfg.effects).items():
        if name not in model.effect_names:
            model = model.with_effect(effect_class(name)(**(options or {})))
        elif options:
            model = model.with_effect(dataclasses.replace(model.effect(name), **options))  # type: ignore[type-var]
    return model


def gone(cfg: DictConfig, model: RobotModel) -> set[str]:
    """Parameters that this model has lost with the effects of `ablate`."""
    return set(base_model(cfg).parameters()) - set(model.parameters())


def without_effects(cfg: DictConfig, folder: Path) -> Fit | None:
    """The same identification with the effects of `ablate` switched off."""
    model = base_model(cfg)
    effects = [name for name in cfg.ablate if name in model.effect_names]
    if not effects:
        return None
    name = "_".join(effects)
    identification = build(cfg, model.without(*effects), f"without {', '.join(effects).upper()}")
    settings = read_settings(cfg, HydraConfig.get().sweeper, folder)
    keys = [PREFIX + parameter for parameter in identification.names]
    settings = dataclasses.replace(
        settings,
        search_space={key: settings.search_space[key] for key in keys},
        nominal=None if settings.nominal is None else {key: settings.nominal[key] for key in keys},
        storage=str(folder / f"study_without_{name}.journal"),
        study_name=f"without_{name}",
    )
    study = run_study(identification.evaluate, settings, identity=identification.identity)
    return identification.finish(study, **cfg.refine)


def duration(started: datetime, study: optuna.Study) -> float:
    """Wall time so far [s], including earlier jobs of the same study that the sweeper ran."""
    seconds = (datetime.now() - started).total_seconds()
    begun = [t.datetime_start for t in study.trials if t.datetime_start]
    ended = [t.datetime_complete for t in study.trials if t.datetime_complete]
    if begun and ended and min(begun) < started:
        seconds += (max(ended) - min(begun)).total_seconds()
    return seconds


def main(cfg: DictConfig) -> Any:
    """Evaluate a population for the sweeper, or run the study and report it."""
    torch.set_num_threads(1)
    started = datetime.now()
    for name in cfg.ablate:
        effect_class(name)
    model = base_model(cfg)
    folder = output_folder()
    if cfg.population is None:  # checked before anything is simulated
        Refine(**plain(cfg.refine))
        read_settings(cfg, HydraConfig.get().sweeper, folder)
    identification = build(cfg, model, f"with {', '.join(cfg.ablate).upper()}" if cfg.ablate else "model")
    if cfg.population is None:
        identification.check()

    def report(study: optuna.Study) -> Identified:
        fit = identification.finish(study, **cfg.refine)
        compared = datetime.now()
        ablated = without_effects(cfg, folder)
        ablated_seconds = (datetime.now() - compared).total_seconds()
        save_model(fit.model, folder / "model.yaml")
        if ablated is not None:
            label = ablated.label.lower().replace(", ", "_").replace(" ", "_")
            save_model(ablated.model, folder / f"model_{label}.yaml")
        values = report_identification(
            fit,
            ablated,
            run_folder(cfg, model="model.yaml"),
            wall_seconds=duration(started, study),
            ablated_seconds=ablated_seconds,
            joints=identification.joints,
        )
        following = f"op3 predict {shlex.quote(f'model={folder}/model.yaml')} data=<other logs>"
        return reported(Identified, values, model=fit.model, following=following)

    return sweep_or_report(cfg, identification.evaluate, report, identity=identification.identity)
