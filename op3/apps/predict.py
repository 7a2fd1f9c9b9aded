"""Measure the error of a model on logs that it was not fitted to, with 90 % intervals.

op3 predict model=<model.yaml or name> data=<logs> [where='{firmware_gain: 8}']
op3 predict -m model=outputs/identify/<run>,paper data=<logs>
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import reported
from op3.apps.fields import plain
from op3.apps.support import focus_joints, logs_where, run_folder
from op3.identify.prediction_score import PredictionScore, predict_logs
from op3.report.prediction_page import report_prediction
from op3.rollout import read_logs
from op3.sim import find_model, model_for


@dataclass(frozen=True, kw_only=True)
class Predicted(CommandResult):
    """Errors of a model's predictions of logs.

    Attributes:
        score: errors with intervals, of all logs and by channel, joint and motion.
    """

    score: PredictionScore


def predict(
    data: str | Path | Sequence[str | Path],
    model: str | Path | None = None,
    *,
    robot: str | Path | None = None,
    where: Mapping[str, Any] | None = None,
    joints: Sequence[str] | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    wandb: str = "disabled",
) -> Predicted:
    """Simulate the commands of logs with a model and compare with the measurements.

    Args:
        data: a log, a folder or pattern of logs, or a list of them.
        model: path of a ``model.yaml``, or a name in ``assets/models``; None: the robot's own.
        robot: robot of the logs; None: as in the logs.
        where: metadata that logs must have; None: all logs.
        joints: joints included in the error; None: the controlled joints in the robot file.
        seed: seed of the bootstrap.
        folder: folder for page and numbers; None: a temporary folder.
        wandb: ``offline``, ``online`` or ``disabled``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("predict", **locals()) as cfg:
        return main(cfg)


def main(cfg: DictConfig) -> Predicted:
    """Simulate the logs, measure the errors, and write the report."""
    torch.set_num_threads(1)
    started = time.monotonic()
    logs = logs_where(read_logs(plain(cfg.data), cfg.robot), plain(cfg.where), "where")
    joints = focus_joints(plain(cfg.joints), logs)
    score = predict_logs(
        model_for(logs[0].robot, cfg.model), logs, joints=joints, bench_timestep=cfg.bench_timestep, seed=cfg.seed
    )
    chosen = cfg.model or logs[0].robot.file.law
    path = find_model(chosen) if chosen else Path(f"{logs[0].robot.name}'s data sheets")
    values = report_prediction(
        score,
        run_folder(cfg),
        model=path.parent.name if path.name == "model.yaml" else path.stem,
        wall_seconds=time.monotonic() - started,
        joints=joints,
    )
    return reported(Predicted, values, score=score)
