"""Which logs are diagnosed, and their split into fitted runs and held-out runs, on which the gap is reported."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from op3.rollout import LogError, Rollout, stand_tilt

SHOW_SHARE = 0.2
"""Share of held-out runs if no command was repeated."""

SAME_COMMAND = 1e-3
"""Numerical: largest difference of equal commands [rad, A/rad, A s/rad], because text logs are rounded."""

SAME_TILT = 0.02
"""Numerical: largest difference between tilts of the same stand [rad]."""

FEW_ROWS, SAME_LENGTH = 3, 0.01
"""Numerical: allowed difference in length between runs of the same commands, in rows or as a share."""

SHORTEST = 2.0
"""Shorter logs are not used [s]."""

MOUNT_ORDER = ("stand", "pendulum", "floor")
"""Mounts in order of preference; logs of a stand contain most information about servos."""

FEWEST_RUNS = 5
"""If there are fewer runs, each is cut in time instead of being held out or left out."""


@dataclass(frozen=True, eq=False)
class LogSplit:
    """Logs by their use; no log has two uses.

    Attributes:
        fit: logs to which parameters are fitted, and which are left out in turn to decide on findings.
        show: held-out logs, used only to report the gap.
        repeats: groups of logs with the same commands, as indices into `show`; empty without repeats.
    """

    fit: tuple[Rollout, ...]
    show: tuple[Rollout, ...]
    repeats: tuple[tuple[int, ...], ...] = ()


def diagnosed_mount(logs: Sequence[Rollout]) -> tuple[list[Rollout], dict[str, list[Rollout]]]:
    """The logs that are diagnosed, and the logs of other mounts, on which the gap is reported.

    Raises:
        LogError: if logs are of different robots, servos or joints, or mix a bench and a robot.
    """
    by_mount: dict[str, list[Rollout]] = {}
    for log in logs:
        by_mount.setdefault(log.metadata.mount, []).append(log)
    if "pendulum" in by_mount and len(by_mount) > 1:
        raise LogError(
            f"logs of a bench are mixed with logs of a robot ({', '.join(sorted(by_mount))})",
            "diagnose them separately",
            source=by_mount["pendulum"][0].metadata.recording,
            column="mount",
        )
    fields = {"robot_file": "robots", "robot": "kinds of robots", "servo": "servos"}
    for field, what in fields.items():
        of_robot = field == "robot_file"
        values = {log.robot.reference if of_robot else getattr(log.metadata, field): log for log in logs}
        values.pop(None, None)
        if len(values) > 1:
            raise LogError(
                f"the logs are of different {what} ({', '.join(sorted(values))})",
                "diagnose the logs of each separately",
                source=list(values.values())[-1].metadata.recording,
                column=field,
            )
    for log in logs:
        if log.joints != by_mount[log.metadata.mount][0].joints:
            raise LogError(
                f"its joints differ from those of {by_mount[log.metadata.mount][0].metadata.recording}",
                "diagnose logs of one set of joints at a time",
                source=log.metadata.recording,
                column="joints",
            )
    first = next((mount for mount in MOUNT_ORDER if mount in by_mount), next(iter(by_mount), ""))
    return by_mount.pop(first, []), by_mount


def split_logs(logs: Sequence[Rollout], seed: int = 0) -> LogSplit:
    """Split by run, before anything is fitted.

    Repeats of a command are held out, because their difference is the noise floor; without repeats, a fifth of the runs
    with different motions is held out. If there are fewer than `FEWEST_RUNS` runs, the first 80 % of each are fitted
    and the rest is held out. Duplicates of a log are dropped.

    Raises:
        LogError: if no log is long enough.
    """
    usable = _distinct([log for log in logs if log.duration >= SHORTEST])
    if not usable:
        raise LogError(
            f"no log is {SHORTEST:g} s long",
            "record at least a few seconds, better 100 s in several runs",
            column="time",
        )
    if len(usable) < FEWEST_RUNS:
        return _split_in_time(usable)
    rng = np.random.default_rng([seed, 7])
    groups = repeats(usable)
    repeated = [i for group in groups for i in group]
    rest = [i for i in range(len(usable)) if i not in repeated]
    show = list(repeated)
    if len(rest) < 3:  # all runs of one command have the same use
        group_of = {group[0]: list(group) for group in groups}
        heads = [*group_of, *rest]
        if len(heads) < 2:
            return _split_in_time(usable)
        show = [i for head in _pick(usable, heads, 1, rng) for i in group_of.get(head, [head])]
    elif not show:
        show = _pick(usable, rest, max(1, round(SHOW_SHARE * len(rest))), rng)
    return LogSplit(
        fit=tuple(log for i, log in enumerate(usable) if i not in show),
        show=tuple(usable[i] for i in show),
        repeats=tuple(tuple(show.index(i) for i in group) for group in groups if group[0] in show),
    )


def _distinct(logs: Sequence[Rollout]) -> list[Rollout]:
    """The logs without duplicates, which may have different names."""
    by_content: dict[str, Rollout] = {}
    for log in logs:
        by_content.setdefault(log.fingerprint(), log)
    return list(by_content.values())


def repeats(logs: Sequence[Rollout]) -> tuple[tuple[int, ...], ...]:
    """Groups of logs with equal commands, as indices."""
    groups: list[list[int]] = []
    for i, log in enumerate(logs):
        for group in groups:
            if _same_commands(logs[group[0]], log):
                group.append(i)
                break
        else:
            groups.append([i])
    return tuple(tuple(group) for group in groups if len(group) > 1)


def _same_commands(log: Rollout, other: Rollout) -> bool:
    if log.joints != other.joints or log.metadata.mount != other.metadata.mount:
        return False
    rows = min(log.rows, other.rows)
    if max(log.rows, other.rows) - rows > max(FEW_ROWS, SAME_LENGTH * rows):
        return False
    if (log.metadata.mass, log.metadata.length) != (other.metadata.mass, other.metadata.length):
        return False
    keys = [key for key in log.channels if key[0] == "command"]
    if keys != [key for key in other.channels if key[0] == "command"]:
        return False
    if log.metadata.mount == "stand":
        tilts = np.array([stand_tilt(each) or (0.0, 0.0) for each in (log, other)])
        if np.abs(tilts[0] - tilts[1]).max() > SAME_TILT:
            return False
    return all(np.allclose(log.array(key)[:rows], other.array(key)[:rows], rtol=0, atol=SAME_COMMAND) for key in keys)


def _pick(logs: Sequence[Rollout], among: Sequence[int], count: int, rng: np.random.Generator) -> list[int]:
    """A random choice of runs: one per motion in turn, beginning with the motion that has most runs left."""
    motions: dict[str, list[int]] = {}
    for i in rng.permutation(np.array(among, int)).tolist():
        motions.setdefault(re.sub(r"[\d_.-]+$", "", logs[i].metadata.motion or "motion"), []).append(i)
    turns = [((len(runs) - k) / (1 + 2 * k), name, i) for name, runs in motions.items() for k, i in enumerate(runs)]
    return [i for *_, i in sorted(turns, reverse=True)[:count]]


def _split_in_time(logs: Sequence[Rollout]) -> LogSplit:
    parts = []
    for log in logs:
        cuts = float(log.array("time")[0, 0]) + log.duration * np.array([0.0, 0.8, 1.0])
        cuts[-1] += 1.0
        parts.append([log.between(float(begin), float(end)) for begin, end in pairwise(cuts)])
    return LogSplit(*(tuple(part) for part in zip(*parts, strict=True)))
