"""Which logs are fitted, and on which the gap is only shown."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from op3.rollout import LogError, Rollout, stand_tilt

SHOW_SHARE = 0.2
"""Share of the runs that only show, where no command was repeated."""

SAME_COMMAND = 1e-3
"""Differences up to which commands are the same [rad, A/rad, A s/rad]: logs are rounded, and written as text."""

SAME_TILT = 0.02
"""Differences up to which two stands are tilted alike [rad]."""

FEW_ROWS, SAME_LENGTH = 3, 0.01
"""Rows, or share of them, by which runs of the same commands may differ in length."""

SHORTEST = 2.0
"""Logs shorter than this are not used [s]."""


@dataclass(frozen=True, eq=False)
class LogSplit:
    """Logs by what they are used for; no log serves two purposes.

    Attributes:
        fit: parameters are fitted to these, and names decided by leaving some of these out in turn.
        show: the gap is shown on these; nothing is chosen by them.
        repeats: groups of logs with the same commands, as indices into `show`; empty where nothing was repeated.
    """

    fit: tuple[Rollout, ...]
    show: tuple[Rollout, ...]
    repeats: tuple[tuple[int, ...], ...] = ()


def split_logs(logs: Sequence[Rollout], seed: int = 0) -> LogSplit:
    """Split by run; fixed before anything is fitted.

    Runs that repeat the same commands show, as their spread is the noise floor; where no command was repeated, a fifth
    of the runs, of different motions, shows. With fewer than five runs, each is cut in time: the first 80 % fit, the
    rest shows. Logs of the same numbers are one.

    Raises:
        LogError: if no log is long enough.
    """
    usable = _different([log for log in logs if log.duration >= SHORTEST])
    if not usable:
        raise LogError(
            f"no log is {SHORTEST:g} s long",
            "record at least a few seconds, better 100 s in several runs",
            column="time",
        )
    if len(usable) < 5:
        return _split_in_time(usable)
    rng = np.random.default_rng([seed, 7])
    groups = repeats(usable)
    repeated = [i for group in groups for i in group]
    rest = [i for i in range(len(usable)) if i not in repeated]
    show = list(repeated)
    if len(rest) < 3:  # then a command's runs go one way together
        alike = {group[0]: list(group) for group in groups}
        heads = [*alike, *rest]
        if len(heads) < 2:
            return _split_in_time(usable)
        show = [i for head in _pick(usable, heads, 1, rng) for i in alike.get(head, [head])]
    elif not show:
        show = _pick(usable, rest, max(1, round(SHOW_SHARE * len(rest))), rng)
    return LogSplit(
        fit=tuple(log for i, log in enumerate(usable) if i not in show),
        show=tuple(usable[i] for i in show),
        repeats=tuple(tuple(show.index(i) for i in group) for group in groups if group[0] in show),
    )


def _different(logs: Sequence[Rollout]) -> list[Rollout]:
    """Each log once, whatever it is called."""
    known: dict[str, Rollout] = {}
    for log in logs:
        known.setdefault(log.fingerprint(), log)
    return list(known.values())


def repeats(logs: Sequence[Rollout]) -> tuple[tuple[int, ...], ...]:
    """Groups of logs whose commands are equal, as indices."""
    groups: list[list[int]] = []
    for i, log in enumerate(logs):
        for group in groups:
            if _same_commands(logs[group[0]], log):
                group.append(i)
                break
        else:
            groups.append([i])
    return tuple(tuple(group) for group in groups if len(group) > 1)


def _same_commands(one: Rollout, other: Rollout) -> bool:
    if one.joints != other.joints or one.metadata.mount != other.metadata.mount:
        return False
    rows = min(one.rows, other.rows)
    if max(one.rows, other.rows) - rows > max(FEW_ROWS, SAME_LENGTH * rows):
        return False
    if (one.metadata.mass, one.metadata.length) != (other.metadata.mass, other.metadata.length):
        return False
    keys = [key for key in one.channels if key[0] == "command"]
    if keys != [key for key in other.channels if key[0] == "command"]:
        return False
    if one.metadata.mount == "stand":
        tilts = np.array([stand_tilt(log) or (0.0, 0.0) for log in (one, other)])
        if np.abs(tilts[0] - tilts[1]).max() > SAME_TILT:
            return False
    return all(np.allclose(one.array(key)[:rows], other.array(key)[:rows], rtol=0, atol=SAME_COMMAND) for key in keys)


def _pick(logs: Sequence[Rollout], among: Sequence[int], count: int, rng: np.random.Generator) -> list[int]:
    """Runs drawn one of each kind in turn, the kind with the most runs left first."""
    kinds: dict[str, list[int]] = {}
    for i in rng.permutation(np.array(among, int)).tolist():
        kinds.setdefault(re.sub(r"[\d_.-]+$", "", logs[i].metadata.motion or "motion"), []).append(i)
    turns = [((len(of) - k) / (1 + 2 * k), kind, i) for kind, of in kinds.items() for k, i in enumerate(of)]
    return [i for *_, i in sorted(turns, reverse=True)[:count]]


def _split_in_time(logs: Sequence[Rollout]) -> LogSplit:
    parts = []
    for log in logs:
        cuts = float(log.array("time")[0, 0]) + log.duration * np.array([0.0, 0.8, 1.0])
        cuts[-1] += 1.0
        parts.append([log.between(float(begin), float(end)) for begin, end in pairwise(cuts)])
    return LogSplit(*(tuple(part) for part in zip(*parts, strict=True)))
