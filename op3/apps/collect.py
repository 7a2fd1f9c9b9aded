"""Record a motion, a plan of motions or a policy on a robot, once or several times.

op3 collect source=stand_in motion=squat [world=eta_060] [mount=stand] [repeats=3] [seed=1]
op3 collect world=random world_seed=7 motion=squat_heldout
op3 collect motion=chirp_knee mount=stand
op3 collect plan=outputs/design_excitation/<run>/plan.yaml
op3 collect source=emulated|real motion=squat [port=/dev/ttyUSB0] [mount=stand]
op3 collect source=emulated|real policy=assets/policies/balance [duration=10] [repeats=5]
op3 collect source=emulated policy=assets/policies/balance task=balance_eval repeats=10
op3 collect -m world=eta_060,eta_070,eta_080
op3 collect robot=path/to/my_robot.yaml source=model motion=multisine mount=stand

The same command with the same hydra.run.dir continues an interrupted recording.
"""

import datetime
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import by_name, output_folder
from op3.apps.job import goes_on
from op3.apps.progress import ProgressLine
from op3.apps.support import ASKED, built, check_same, library_motion, remember
from op3.common.settings import read_yaml
from op3.deploy import Stop
from op3.deploy.dynamixel_bus import Unplugged
from op3.deploy.exit_codes import ExitCode
from op3.deploy.ticker import PERIOD
from op3.motions import Motion, check_motion
from op3.policy import PolicyBundle
from op3.policy.card import check_card
from op3.robot import load_robot
from op3.rollout import MOUNTS, Rollout, git_hash

INTERRUPTED = goes_on("recordings")


@dataclass(frozen=True, kw_only=True)
class Collected(CommandResult):
    """Recorded logs.

    Attributes:
        folders: folders of the logs, in the order of recording.
    """

    folders: tuple[Path, ...]

    @property
    def logs(self) -> list[Rollout]:
        """The logs."""
        return [Rollout.load(folder) for folder in self.folders]


def collect(
    motion: str | None = None,
    *,
    source: str = "stand_in",
    robot: str | Path | None = None,
    policy: str | Path | None = None,
    task: str | None = None,
    plan: str | Path | None = None,
    mount: str | None = None,
    world: str | None = None,
    world_seed: int | None = None,
    model: str | Path | None = None,
    port: str | None = None,
    repeats: int = 1,
    seed: int = 0,
    folder: str | Path | None = None,
    overrides: Sequence[str] = (),
) -> Collected:
    """Record a motion, a plan of motions or a policy's episodes on a robot.

    Args:
        motion: a name in ``conf/motion`` or ``conf/variants.yaml``.
        source: the robot: ``stand_in``, ``emulated``, ``real`` or ``model``.
        robot: a name in ``assets/robots`` or the path of a robot file; None: the OP3.
        policy: folder of a bundle whose episodes are recorded instead of a motion.
        task: task of the policy, a name in ``conf/task``.
        plan: path of a ``plan.yaml``, played instead of a motion.
        mount: ``floor`` or ``stand``.
        world: world of a stand-in: a name in ``assets/worlds.yaml``, a path, or ``random``.
        world_seed: seed of ``world="random"``.
        model: model for the sources ``emulated`` and ``model``, instead of a stand-in or the robot's own.
        port: serial port of a real robot.
        repeats: number of recordings.
        seed: seed of all random numbers in the recordings.
        folder: folder of the run, where an interrupted run continues; None: a temporary folder.
        overrides: Hydra overrides of further settings in ``conf/collect.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
        op3.deploy.Stop: if a robot on a bus ends the recording.
    """
    with configured("collect", **locals()) as cfg:
        return run(cfg)


def run(cfg: DictConfig) -> Collected:
    """Record the number of logs that the config requests."""
    folders = tuple(record_all(cfg))
    logs = [Rollout.load(folder) for folder in folders]
    rows, seconds = sum(log.rows for log in logs), sum(log.duration for log in logs)
    falls = sum(bool(log.metadata.fallen) for log in logs)
    fell = f"; the robot fell in {falls}" if falls else ""
    headline = f"{len(logs)} recording{'s' * (len(logs) != 1)}: {rows} rows, {seconds:.2f} s in total{fell}."
    return Collected(output_folder(), headline, folders=folders)


def record_all(cfg: DictConfig) -> list[Path]:
    """Record all repeats and return the folders of the logs."""
    check_same(place(ASKED), asked())
    if cfg.plan is not None:
        return collect_plan(cfg, read_plan(Path(cfg.plan)))
    if cfg.mount not in MOUNTS[:2]:
        raise ValueError(f"mount must be {' or '.join(MOUNTS[:2])}, got {cfg.mount!r}")
    if cfg.policy is not None:
        return collect_episodes(cfg)
    motion = built(cfg.motion)
    check_made_for(motion, cfg.robot)
    check_motion(motion, cfg.mount)
    robot = built(cfg.source)
    name = HydraConfig.get().runtime.choices.motion
    return [record(cfg, robot, motion, f"{name}-{number}") for number in range(cfg.repeats)]


def check_made_for(motion: Motion, robot: str) -> None:
    """Raise an error if the motion belongs to another robot."""
    known = load_robot(robot)
    if load_robot(motion.robot).path != known.path:
        general = "chirp, multisine, staircase or triangle"
        raise ValueError(
            f"motion {motion.name!r} is for the robot {motion.robot}, not for {known.name}; choose motion={general}"
        )


def collect_plan(cfg: DictConfig, plan: list[tuple[str, str]]) -> list[Path]:
    """Record the motions in turn, after checking all of them."""
    motions = {name: library_motion(name, cfg.robot) for name, _ in plan}
    for name, mount in plan:
        check_made_for(motions[name], cfg.robot)
        check_motion(motions[name], mount)
    robots: dict[str, Any] = {}
    say, total = ProgressLine(), len(plan) * cfg.repeats
    counts: dict[str, int] = {}
    folders = []
    for name, mount in plan:
        if mount not in robots:
            there = OmegaConf.merge(cfg, {"mount": mount})
            robots[mount] = built(there.source)
        for _ in range(cfg.repeats):
            counts[name] = counts.get(name, -1) + 1
            folders.append(record(cfg, robots[mount], motions[name], f"{name}-{counts[name]}"))
            say("recording", len(folders) / total)
    return folders


def read_plan(path: Path) -> list[tuple[str, str]]:
    """Motions and their mounts from a plan written by `op3 design` or by hand.

    Raises:
        ValueError: if the file is not a valid plan; the message names the faulty entry.
    """
    entries = read_yaml(path).get("plan")
    if not isinstance(entries, list) or not entries:
        raise ValueError(f"{path} is not a plan: write `plan:` with a list of {{motion: ..., mount: ...}}")
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict) or set(entry) != {"motion", "mount"} or entry["mount"] not in MOUNTS[:2]:
            raise ValueError(f"{path}, entry {number}: give a motion and a mount (floor or stand), got {entry!r}")
    return [(entry["motion"], entry["mount"]) for entry in entries]


def collect_episodes(cfg: DictConfig) -> list[Path]:
    """Record episodes of a policy."""
    robot = built(cfg.source)
    if not hasattr(robot, "run_policy"):
        raise ValueError("this source only plays motions; record a policy with source=emulated or source=real")
    bundle, task = PolicyBundle.load(cfg.policy), cfg.get("task")
    if HydraConfig.get().runtime.choices.source == "real" and cfg.card != "ignore":
        check_card(cfg.policy, bundle)
    if task is not None:
        task = built(task)
        task.check_policy(bundle.manifest, f"policy={cfg.policy}")
    folders, say = [], ProgressLine()
    for number in range(cfg.repeats):
        say("episodes", number / cfg.repeats)
        name = f"{Path(cfg.policy).name}-{number}"
        if recorded(robot, name):
            folders.append(place(name))
            continue
        options = {"cycle": cfg.cycle, "task": task, "recording": name}
        folders.append(save(robot.run_policy(bundle, cfg.duration, **options), name))
    return folders


def record(cfg: DictConfig, robot: Any, motion: Motion, name: str) -> Path:
    """Play a motion once and save the log, unless the log already exists; return its folder."""
    if recorded(robot, name):
        return place(name)
    gains = {name: _own(motion, name) if cfg[name] is None else cfg[name] for name in ("p_gain", "d_gain")}
    for make in load_robot(motion.robot).servos:
        # limit: a torque K d w over one period T reverses the speed w of a bare rotor with inertia J at the output
        most = 2 * make.motor.armature.si / (make.output_constant * PERIOD)
        if make.loop == "current" and gains["d_gain"] >= most:
            given = gains["d_gain"]
            raise ValueError(
                f"d_gain must be below {most:.2f} A s/rad, above which the {make.name} oscillates; got {given}"
            )
    return save(robot.play(motion, **gains, recording=name), name)


def asked() -> dict[str, str]:
    """The settings of this run."""
    return by_name(HydraConfig.get().overrides.task)


def place(name: str) -> Path:
    """Path of a file or folder in the run's folder."""
    return output_folder() / name


def recorded(robot: Any, name: str) -> bool:
    """Whether a recording already exists and is therefore skipped."""
    if not place(name).exists():
        return False
    print(f"{place(name)}: already recorded", flush=True)
    robot.skip()
    return True


def save(rollout: Rollout, name: str) -> Path:
    """Write a log into the run's folder and print how it ended; return its folder."""
    known = {"date": datetime.datetime.now().isoformat(timespec="seconds"), "git_hash": git_hash()}
    rollout = Rollout(rollout.data, rollout.metadata.replace(**known))
    remember(place(ASKED), asked())
    folder = rollout.save(place(name))
    extra = rollout.metadata.extra
    ended = extra.get("ended_by")
    outcome = f"ended: {ended}" if ended else "the robot fell" if rollout.metadata.fallen else "complete"
    if "afterwards" in extra:
        outcome += f" at its end; while moving to the end pose: {extra['afterwards']}"
    print(f"{folder}: {rollout.rows} rows, {rollout.duration:.2f} s, {outcome}")
    return folder


def _own(motion: Motion, name: str) -> Any:
    """A gain of the motion in the form that a robot takes: one number, or [row, 1] for all joints."""
    gain = np.asarray(getattr(motion, name))
    return gain[:, None] if gain.ndim else float(gain)


@contextmanager
def exit_code() -> Iterator[None]:
    """Exit with the code for the reason why the robot stopped."""
    try:
        yield
    except (Stop, Unplugged) as error:
        print(error, file=sys.stderr)
        raise SystemExit(int(getattr(error, "code", ExitCode.PORT))) from None


def main(cfg: DictConfig) -> Collected:
    """Compose the robot and the motion, record, save."""
    with exit_code():
        return run(cfg)
