"""Run a policy on a robot, with start checks and limits; the exit code states how the run ended.

op3 deploy policy=assets/policies/balance port=/dev/ttyUSB0 [duration=20] [--yes]
op3 deploy policy=assets/policies/balance port=emulated [world=eta_070] [model=<model.yaml>]
op3 deploy port=/dev/ttyUSB0 mode=read_only
op3 deploy policy=<bundle> log=outputs/deploy/<time>/run mode=replay
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder
from op3.apps.support import seeded_faults
from op3.deploy import (
    Connection,
    ExitCode,
    FollowPolicy,
    HoldPose,
    Limits,
    Plan,
    PolicyRunner,
    calibrate,
    connect,
    read_only,
    replay_policy,
    run,
    setup,
)
from op3.deploy.command_sources import CommandSource, command_source
from op3.deploy.connection import EMULATED, HANG_SCALE, POLICY_RATE
from op3.deploy.dynamixel_bus import Unplugged
from op3.deploy.session import LOG_NAMES
from op3.deploy.start_checks import Check
from op3.policy import PolicyBundle
from op3.policy.card import check_card
from op3.robot import load_robot
from op3.rollout import git_hash, read_log

MODES = ("run", "dry_run", "read_only", "hang", "setup", "calibrate", "replay")


@dataclass(frozen=True, kw_only=True)
class Deployed(CommandResult):
    """How a run on a robot ended.

    Attributes:
        code: exit code; 0: the run ended normally.
    """

    code: ExitCode


def deploy(
    policy: str | Path | None = None,
    port: str = EMULATED,
    *,
    robot: str | Path | None = None,
    mode: str = "run",
    duration: float = 20.0,
    world: str | None = None,
    model: str | Path | None = None,
    confirm: bool = True,
    seed: int = 0,
    folder: str | Path | None = None,
    overrides: Sequence[str] = (),
) -> Deployed:
    """Run a policy on a robot, or on an emulated one, with all start checks and limits.

    Args:
        policy: folder of a bundle; None holds the home pose.
        port: a device, a pseudo-terminal, or ``emulated``.
        robot: a name in ``assets/robots`` or the path of a robot file; None: the OP3.
        mode: ``run``, ``dry_run``, ``read_only``, ``hang``, ``setup``, ``calibrate`` or ``replay``.
        duration: length of the run [s].
        world: world of an emulated robot: a name in ``assets/worlds.yaml``, a path, or ``random``.
        model: model of an emulated robot instead of a stand-in: a ``model.yaml``, or ``own``.
        confirm: whether to ask before torque is switched on.
        seed: seed of an emulated robot.
        folder: folder of the run; None: a temporary folder.
        overrides: Hydra overrides of further settings in ``conf/deploy.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("deploy", **locals()) as cfg:
        code = carry_out(cfg)
        return Deployed(output_folder(), f"The run ended with {code.name} ({int(code)}).", code=code)


def open_robot(cfg: DictConfig) -> Connection:
    """The robot on the configured port."""
    emulation: dict[str, Any] = {}
    if cfg.port == EMULATED:
        emulation = {name: cfg[name] for name in ("world", "world_seed", "model", "seed", "scene")} | {
            "record": cfg.frames,
            "faults": seeded_faults(cfg.faults),
            # as the person would hold it
            "joint_position": load_robot(cfg.robot).pose(cfg.pose) if cfg.mode == "calibrate" else None,
            "jig": cfg.mode == "calibrate",
            "powered": cfg.mode in ("read_only", "calibrate"),  # these may not switch the supply on
        }
    mount = "stand" if cfg.mode == "hang" else cfg.mount
    calibration = None if cfg.mode == "calibrate" else cfg.calibration
    common = {"robot": cfg.robot, "mount": mount, "confirm": cfg.confirm, "calibration": calibration}
    return connect(cfg.port, **common, **emulation)


def load_runner(cfg: DictConfig) -> PolicyRunner | None:
    """The policy, None where there is none."""
    if cfg.policy is None:
        return None
    return PolicyRunner(PolicyBundle.load(cfg.policy), cfg.cycle, robot=cfg.robot, p_gain=cfg.limits.p_gain)


def commands_of(cfg: DictConfig, runner: PolicyRunner | None) -> CommandSource | None:
    """Source of the velocity commands; only a policy that observes a commanded velocity takes any."""
    if cfg.commands is None:
        return None
    if runner is None or "command" not in runner.bundle.manifest.layout:
        raise ValueError(
            f"commands={cfg.commands}: this policy takes no commands; give a policy trained on walk_command"
        )
    return command_source(str(cfg.commands))


def check_policy(cfg: DictConfig, runner: PolicyRunner) -> Check:
    """Whether the policy's card allows a robot to run it."""
    if cfg.card == "ignore":
        return Check("policy card", True, "ignored")
    try:
        card = check_card(cfg.policy, runner.bundle)
    except ValueError as error:
        return Check("policy card", False, f"{error}; to run the policy anyway, set card=ignore")
    return Check("policy card", True, f"{card.verdict} at {card.task}")


def carry_out(cfg: DictConfig) -> ExitCode:
    """Do what the config says."""
    if cfg.mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}, got {cfg.mode!r}")
    if cfg.card not in ("required", "ignore"):
        raise ValueError(f"card must be required or ignore, got {cfg.card!r}")
    runner = load_runner(cfg)
    if runner is not None and cfg.mode in ("run", "hang"):
        print(check := check_policy(cfg, runner))
        if not check.ok:
            return ExitCode.START_CHECK
    if cfg.mode == "replay":
        if cfg.log is None or runner is None:
            raise ValueError("mode=replay needs policy=<bundle> and log=<folder of a run>")
        result = replay_policy(read_log(cfg.log), runner)
        print(result)
        return ExitCode.OK if result.ok else ExitCode.REPLAY
    limits = Limits(**OmegaConf.to_container(cfg.limits, resolve=True))  # type: ignore[arg-type]
    folder = output_folder()
    taken = next((folder / name for name in LOG_NAMES if (folder / name).exists()), None)
    if taken is not None:
        raise ValueError(f"{taken} already exists, and a log is never overwritten; choose another hydra.run.dir")
    plan = Plan(
        limits,
        dry=cfg.mode == "dry_run",
        current_scale=HANG_SCALE if cfg.mode == "hang" else 1.0,
        end_pose=cfg.end_pose,
        folder=folder,
        panel=cfg.panel,
    )
    source = commands_of(cfg, runner)
    connection = open_robot(cfg)
    try:
        if cfg.mode == "read_only":
            return read_only(connection, cfg.duration, plan).code
        if cfg.mode == "setup":
            return setup(connection)
        if cfg.mode == "calibrate":
            return calibrate(connection, cfg.calibration_out, pose_name=cfg.pose)
        outcome = run_on(connection, runner, plan, cfg.duration, source)
    finally:
        connection.close()
        if source is not None:
            source.close()
    for log in outcome.logs:
        print(folder / log)
    return outcome.code


def run_on(
    connection: Connection,
    runner: PolicyRunner | None,
    plan: Plan,
    duration: float,
    source: CommandSource | None = None,
) -> Any:
    """Run the policy, or hold the stand pose."""
    if runner is None:
        home = connection.bus.robot.home
        make = lambda: HoldPose(home, duration=duration, log="run")  # noqa: E731
        return run(connection, make, plan, motion="hold", git_hash=git_hash())
    manifest = runner.bundle.manifest
    known: dict[str, Any] = {"model_hash": manifest.training.model_hash or None, "git_hash": git_hash()}
    make = lambda: FollowPolicy(runner, duration, source)  # noqa: E731
    return run(connection, make, plan, motion=manifest.task, policy_rate=POLICY_RATE, **known)


def main(cfg: DictConfig) -> None:
    """Run, and end with the exit code."""
    torch.set_num_threads(1)
    try:
        code = carry_out(cfg)
    except Unplugged as error:
        print(error, file=sys.stderr)
        code = ExitCode.PORT
    except KeyboardInterrupt:  # outside a run nothing is energised
        code = ExitCode.INTERRUPTED
    raise SystemExit(int(code))
