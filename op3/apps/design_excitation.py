"""Plan the motions that reduce the uncertainty of parameters most per second of robot time.

op3 design groups=[gear,friction] seconds=60 [mounts=[floor]] [model=<model.yaml>]
op3 collect plan=<its folder>/plan.yaml source=stand_in
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder, provenance, reported
from op3.apps.fields import plain
from op3.apps.support import library_motion
from op3.common.assets import named_configs
from op3.identify.design import PlannedRecording, check_choice, choose, information
from op3.identify.identification import PREFIX
from op3.identify.resolvers import chosen_model
from op3.identify.search_space import parse_search_space
from op3.report import RunFolder
from op3.report.design_page import report_design
from op3.robot import load_robot


@dataclass(frozen=True, kw_only=True)
class Designed(CommandResult):
    """A plan of recordings.

    Attributes:
        plan: file for the argument `plan` of `collect`.
    """

    plan: Path


def design(
    groups: Sequence[str] | None = None,
    *,
    seconds: float = 60.0,
    wanted: Sequence[str] | None = None,
    model: str | Path | None = None,
    robot: str | Path | None = None,
    mounts: Sequence[str] | None = None,
    motions: Sequence[str] | None = None,
    folder: str | Path | None = None,
    overrides: Sequence[str] = (),
) -> Designed:
    """Plan the motions that reduce the uncertainty of parameters most per second of robot time.

    Args:
        groups: parameter groups to be identified; None: ``motor, gear, friction, body``.
        seconds: total robot time [s].
        wanted: parameters whose intervals count; None: all.
        model: path of a ``model.yaml`` or a name in ``assets/models``; None: the robot's own.
        robot: a name in ``assets/robots`` or the path of a robot file; None: the OP3.
        mounts: ``floor``, ``stand`` or both.
        motions: names in ``conf/motion`` or ``conf/variants.yaml``; None: all that the robot can play.
        folder: folder of the run; None: a temporary folder.
        overrides: Hydra overrides of further settings in ``conf/design_excitation.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("design_excitation", **locals()) as cfg:
        return main(cfg)


def judge(cfg: DictConfig, bounds: dict[str, tuple[float, float]]) -> tuple[list[PlannedRecording], dict[str, str]]:
    """Simulate every motion on every mount, and return those that cannot be evaluated with the reason."""
    model, robot = chosen_model(cfg), load_robot(cfg.robot)
    joints = robot.controlled if cfg.joints is None else tuple(cfg.joints)
    robot.indices(joints)  # checked before simulations that take minutes
    candidates, left_out = [], {}
    for name in plain(cfg.motions) or named_configs("motion"):
        motion = library_motion(name, cfg.robot)
        if load_robot(motion.robot).path != robot.path:
            continue
        for mount in (place for place in motion.mounts if place in cfg.mounts):
            try:
                matrix = information(model, motion, mount, bounds, joints=joints)
            except ValueError as error:
                left_out[f"{name} on the {mount}"] = str(error)
                continue
            candidates.append(PlannedRecording(name, mount, motion.duration, matrix))
            print(f"{name} on the {mount}: {motion.duration:.1f} s", flush=True)
    if not candidates:
        raise ValueError(
            f"none of the motions can be played on mounts={list(cfg.mounts)}: {left_out or 'no motion'}; choose others"
        )
    return candidates, left_out


def main(cfg: DictConfig) -> Designed:
    """Evaluate all motions, select some, and write the plan."""
    torch.set_num_threads(1)
    started = time.monotonic()
    folder = output_folder()
    space = parse_search_space(plain(HydraConfig.get().sweeper.params))
    bounds = {name: _ends(space[PREFIX + name]) for name in cfg.parameters if PREFIX + name in space}
    wanted = list(bounds) if cfg.wanted is None else list(cfg.wanted)
    check_choice(list(bounds), wanted, cfg.criterion)
    candidates, left_out = judge(cfg, bounds)
    steps = choose(
        candidates,
        list(bounds),
        wanted,
        criterion=cfg.criterion,
        seconds=cfg.seconds,
        overhead=cfg.overhead,
        mount_change=cfg.mount_change,
        repeats=cfg.repeats,
    )
    plan = {"plan": [{"motion": step.name, "mount": step.mount} for step in steps]}
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))
    values = report_design(
        steps,
        candidates,
        wanted,
        left_out,
        RunFolder(folder, provenance(cfg)),
        time.monotonic() - started,
    )
    return reported(Designed, values, plan=folder / "plan.yaml")


def _ends(distribution: Any) -> tuple[float, float]:
    return float(distribution.low), float(distribution.high)
