"""Logs of a planned excitation, simulated with the model, which allows evaluating it before spending robot time."""

import datetime
from collections.abc import Sequence
from typing import Any

import numpy as np

from op3.motions import Excitation, Motion, check_motion
from op3.replay.log_replay import Replay
from op3.replay.simulate import simulate_motion
from op3.rollout import Metadata, Rollout
from op3.servo import RobotModel

COLD, WARM = 28.0, 58.0
"""Temperatures of servos before and after long work [C]."""

STILL = 0.02
"""A joint that moves less than this counts as not moving [rad]."""

PAUSE = 6.0
"""Time between two runs [s]."""

BEGIN = datetime.datetime(2026, 1, 1)
"""Start of the first planned run; only differences of times matter."""

SIMULATED = (("joint", "position"), ("joint", "velocity"), ("joint", "current"))
"""Channels from the simulation."""


def with_whole_limbs(log: Rollout) -> Rollout:
    """A log of some joints on the stand, extended to their limbs with the other joints held at home."""
    robot = log.robot
    joints = robot.whole_limbs(log.joints)
    if log.metadata.mount != "stand" or log.joints == joints:
        return log
    columns = [joints.index(joint) for joint in log.joints]
    standing, rows = robot.home[robot.indices(joints)], log.rows
    fill = {"position": standing, "p_gain": 6.0, "d_gain": 0.1, "torque_enable": 1.0, "temperature": 25.0}
    arrays: dict[Any, np.ndarray] = {}
    for key in log.channels:
        value = log.array(key)
        if key[0] not in ("joint", "command"):
            arrays[key] = value
            continue
        other = float(value.mean()) if key[1] == "voltage" else fill.get(key[1], 0.0)
        whole = np.tile(np.broadcast_to(other, len(joints)).astype(float), (rows, 1))
        whole[:, columns] = value
        arrays[key] = whole
    return Rollout.from_arrays(arrays, log.metadata.replace(joints=joints))


def planned_suite(model: RobotModel, suite: Sequence[Excitation]) -> list[Rollout]:
    """Logs of one leg on the stand for the runs of a suite, each command once.

    Args:
        suite: runs, see `op3.motions.leg_suite`.
    """
    commands, begin = [], BEGIN
    for number, run in enumerate({run.motion.name: run for run in suite}.values()):
        commands.append(_command(run, number, begin))
        begin += datetime.timedelta(seconds=run.motion.duration + PAUSE)
    logs = []
    for log, prediction in zip(commands, Replay(commands).run(model), strict=True):
        simulated = {key: prediction.channels[key][0].numpy() for key in SIMULATED}
        logs.append(Rollout.from_arrays({key: log.array(key) for key in log.channels} | simulated, log.metadata))
    return logs


def planned_motions(model: RobotModel, motions: Sequence[Motion]) -> list[Rollout]:
    """Logs of library motions on the stand, with only the moving joints.

    Args:
        motions: motions that can be played on the stand.

    Raises:
        ValueError: if a motion cannot be played, or no joint moves.
    """
    for motion in motions:
        check_motion(motion, "stand")
    logs = [simulate_motion(model, motion, "stand") for motion in motions]
    reach = np.max([np.ptp(log.array("joint/position"), axis=0) for log in logs], axis=0)
    columns = np.flatnonzero(reach > STILL)
    if not columns.size:
        raise ValueError(f"no joint moves more than {STILL:g} rad in these motions; choose larger motions")
    joints = tuple(logs[0].joints[column] for column in columns)
    result = []
    for log in logs:
        arrays: dict[Any, np.ndarray] = {
            key: log.array(key)[:, columns] if key[0] in ("joint", "command") else log.array(key)
            for key in log.channels
        }
        result.append(Rollout.from_arrays(arrays, log.metadata.replace(joints=joints)))
    return result


def _command(run: Excitation, number: int, begin: datetime.datetime) -> Rollout:
    """A log with the commands of a run and a leg at rest in the first pose."""
    target = run.motion.position
    ones = np.ones_like(target)
    arrays: dict[Any, np.ndarray] = {
        "time": run.motion.time,
        ("joint", "position"): target[:1] * ones,
        ("joint", "temperature"): (WARM if run.warm else COLD) * ones,
        ("command", "position"): target,
        ("command", "p_gain"): run.p_gain * ones,
        ("command", "d_gain"): run.d_gain * ones,
        ("imu", "orientation"): np.tile([*run.tilt, 0.0], (len(target), 1)),
    }
    metadata = Metadata(
        joints=run.motion.joints,
        robot="simulated",
        mount="stand",
        rate=round(1 / float(np.median(np.diff(run.motion.time))), 6),
        motion=run.motion.name,
        recording=f"planned/{number:02d}",
        date=begin.isoformat(timespec="seconds"),
    )
    return Rollout.from_arrays(arrays, metadata)
