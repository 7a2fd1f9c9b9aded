"""ROS bags, read without ROS by the rosbags package: ROS 2 (sqlite3 and MCAP, folder or file) and ROS 1.

States come from `JointState` messages and trunk readings from `Imu`. Commands come from messages with joint names and
positions: `JointTrajectory`, controller states, `JointState` of a leader or on a command topic, arrays, single numbers.
A trajectory is interpolated from the joint's last target through its points until the next trajectory arrives.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from op3.rollout.errors import LogError
from op3.rollout.finding import WARNING, LogFinding
from op3.rollout.readers.reader import Recording, Stream
from op3.rollout.readers.ros_messages import COMMAND_WORDS, messages, samples, seconds
from op3.rollout.validate import INSTANT

_LEADERS = ("leader", "master", "teleop")
"""Words in the topics of leaders, whose states are the targets of followers."""

_FOLLOWERS = ("follower", "puppet", "slave")
"""First words in names of followers' joints, if the names of leaders' joints begin with one of `_LEADERS`."""

_TRAJECTORY_STEP = 0.01
"""Time between samples of a trajectory [s]."""

_SHARED = 1.0
"""Largest difference between synchronised header clocks [s]."""

_PUBLISHED = 5
"""Smallest number of messages that reveal a second publisher."""

_BETWEEN = 0.15
"""Largest interval between the messages around a single message of a second command publisher [s]."""

_LEAPS = 0.02
"""Largest movement of a joint between messages [rad]; ten times its usual movement is also allowed."""


@dataclass
class Topic:
    """Messages of a topic that contain certain columns.

    Attributes:
        name: Name of the topic.
        kind: Type of its messages.
        columns: Columns of the numbers; `#0`, `#1` and so on for an array.
        rows: Header time (NaN if missing), bag time, and numbers.
        paths: Trajectories by row: times from the start [point] and positions [point, joint].
    """

    name: str
    kind: str
    columns: tuple[str, ...]
    rows: list[list[float]] = field(default_factory=list)
    paths: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def ends(self, kind: str) -> bool:
        """Whether its columns are of this kind, such as `position`."""
        return self.columns[0].endswith(f".{kind}")

    @property
    def is_array(self) -> bool:
        """Whether its numbers have no names."""
        return self.columns[0] == "#0"


class Ros:
    """A bag of ROS 1 or 2."""

    title = "ROS 1 and ROS 2 bags (needs op3[ros])"
    paths = "<bag folder>, <name>.mcap, <name>.db3, <name>.bag"

    def claims(self, path: Path) -> bool:
        """Recognised by the extension, or by the files in the folder."""
        return path.suffix in (".bag", ".mcap", ".db3") or (path.is_dir() and is_bag(path))

    def read(self, path: Path) -> list[Recording]:
        """One recording with all joints that have both states and commands."""
        found: dict[tuple[str, str, tuple[str, ...]], Topic] = {}
        orders: dict[frozenset[str], tuple[str, ...]] = {}  # in the order of first occurrence
        for name, kind, received, message in messages(path):
            names = getattr(message, "name", getattr(message, "joint_names", ()))
            if len(set(names)) < len(names):
                twice = next(one for one in names if list(names).count(one) > 1)
                problem = f"{name} contains the joint {twice} twice in one message"
                raise LogError(problem, "publish every joint under a unique name", source=path)
            stamp = seconds(message.header.stamp) if hasattr(message, "header") else 0.0
            for numbers, points in samples(name, kind, message):
                columns = orders.setdefault(frozenset(numbers), tuple(numbers))
                topic = found.setdefault((name, kind, columns), Topic(name, kind, columns))
                topic.rows.append([stamp if stamp > 0 else math.nan, received, *(float(numbers[c]) for c in columns)])
                if points is not None:
                    order = [list(numbers).index(column) for column in columns]
                    topic.paths.append((points[0], points[1][:, order]))
        doubts: list[LogFinding] = []
        _one_publisher(topics := list(found.values()), path, doubts)
        streams = _streams(_one_source([topic for topic in topics if topic.rows], path), path, doubts)
        if not streams:
            raise LogError("the bag has no joint states", "record sensor_msgs/JointState", source=path)
        streams.sort(key=lambda s: (not any(n.endswith(".position") for n in s.columns), -len(s.time)))
        return [Recording(streams, dict(robot="real", mount="stand"), doubts=doubts)]


def is_bag(folder: Path) -> bool:
    """Whether a folder is a ROS 2 bag, which also has a `metadata.yaml`."""
    about = folder / "metadata.yaml"
    named = about.is_file() and b"rosbag2_bagfile_information" in about.read_bytes()[:200]
    return named or any(folder.glob("*.[dm][bc][3a]*"))


def _one_publisher(topics: list[Topic], path: Path, doubts: list[LogFinding]) -> None:
    """Remove zero messages from a second publisher of a topic; reject the log if both publishers send other values."""
    for topic in (one for one in topics if len(one.rows) >= 20):
        if not (states := topic.ends("position")) and not (topic.ends("target") or topic.is_array):
            continue
        table = np.array(topic.rows)
        values, zero = table[:, 2:], np.asarray(~table[:, 2:].any(1))
        steps = [np.abs(values[n:] - values[:-n]).max(1)[: len(values) - 2] for n in (1, 2)]
        near = max(_LEAPS, 10 * float(np.median(np.minimum(*steps))))
        other, last = zero, values[0]
        begins = (np.diff(zero.astype(int)) == 1) & (np.abs(np.diff(values, axis=0)).max(1) > near)
        if begins.sum() < _PUBLISHED:
            other = np.zeros(len(values), bool)
            for row, value in enumerate(values):
                other[row] = np.abs(value - last).max() > near
                last = last if other[row] else value
            other = ~other if 2 * other.sum() > len(values) else other
        own, foreign = values[~other], values[other]
        if (np.diff(np.asarray(other, int)) == 1).sum() < _PUBLISHED or (
            np.abs(np.diff(own, axis=0)).max(1) > 2 * near
        ).any():
            continue
        if not states and not _stands_singly(np.asarray(other), table[:, 1]):
            continue  # the values alternate regularly
        if np.abs(own - np.median(foreign, axis=0)).max() < near:
            continue  # the joint is really there
        problem = f"{other.sum()} of {len(values)} messages of {topic.name} differ strongly from those before and"
        problem += " after: two programs publish the topic"
        column = None if topic.is_array else topic.columns[0]
        if foreign.any():
            raise LogError(problem, "stop one of the programs, and record again", source=path, column=column)
        remedy = "stop the program that publishes zeros; its messages are ignored here"
        doubts.append(LogFinding(WARNING, problem, remedy, column, check="two publishers"))
        gone = set(table[other, 1].tolist())
        for part in topics:
            if part.name == topic.name:
                kept = [row[1] not in gone for row in part.rows]
                part.rows = list(itertools.compress(part.rows, kept))
                part.paths = list(itertools.compress(part.paths, kept))


def _stands_singly(rows: np.ndarray, time: np.ndarray) -> bool:
    """Whether nearly all rows of this kind occur alone or in pairs, a short time between other rows."""
    edges = np.flatnonzero(np.diff(rows.astype(int)))
    begin, end = edges[rows[edges + 1]], edges[~rows[edges + 1]]
    end = end[end > begin[0]] if len(begin) else end
    begin = begin[: len(end)]
    singly = (end - begin <= 2) & (time[end + 1] - time[begin] < _BETWEEN)
    return bool(len(end)) and float(singly.mean()) > 0.8


def _one_source(topics: list[Topic], path: Path) -> list[Topic]:
    """One topic for each group of columns. Relayed topics are omitted and states of a leader are commands; two
    different topics, or states without commands, are errors."""
    has_commands = any(topic.ends("target") or topic.is_array for topic in topics)
    states = [topic for topic in topics if topic.kind == "JointState" and topic.ends("position")]
    joints = {column.rpartition(".")[0] for topic in states for column in topic.columns}
    for topic in (one for one in topics if one.columns == ("#0",)):  # of a joint that its topic may name
        words = f"_{re.sub('[^A-Za-z0-9]+', '_', topic.name)}_"
        if named := max((joint for joint in joints if f"_{joint}_" in words), key=len, default=None):
            topic.columns = (f"{named}.target",)
    leads = [topic for topic in states if any(word in topic.name.lower() for word in _LEADERS)]
    if leads and len(leads) < len(states):
        names = {topic.name for topic in leads}
        topics = [topic for topic in topics if topic.name not in names or (topic in leads and not has_commands)]
        for topic in leads:
            topic.columns = tuple(column.replace(".position", ".target") for column in topic.columns)
    chosen: dict[tuple[str, ...], Topic] = {}
    for topic in sorted(topics, key=lambda one: -len(one.rows)):
        key = topic.columns
        for other in chosen.values():
            same = topic.kind == other.kind and topic.name != other.name
            if same and (shared := [name for name in topic.columns if name in other.columns]):
                said, known_as = _content(topic, shared), _content(other, shared)
                if 2 * len(said & known_as) > len(topic.rows):
                    continue
                if not topic.is_array:
                    raise _differ(topic, other, path, shared[0])
                key = (topic.name,)  # for other joints, or an error once the joints are known
        chosen.setdefault(key, topic)
    names = sorted({name for topic in chosen.values() for name in topic.columns})
    here, there = ([n.rpartition(".")[0] for n in names if n.endswith(end)] for end in (".position", ".target"))
    if here and not there and not any(topic.is_array for topic in chosen.values()):
        problem = "no topic contains commands for these joints"
        remedy = f"record the topic of the commands; its name must contain one of {', '.join(COMMAND_WORDS)}"
        raise LogError(problem, remedy, source=path, column="command/position")
    alike = {} if {*here} & {*there} else {t: [s for s in here if _behind(s, t) or _behind(t, s)] for t in there}
    named = {f"{t}.target": f"{s[0]}.target" for t, s in alike.items() if len(s) == 1}
    for topic in chosen.values():
        topic.columns = tuple(named.get(name, name) for name in topic.columns)
    return list(chosen.values())


def _behind(name: str, other: str) -> bool:
    """Whether one name is the other with a namespace, or its leader."""
    (first, _, rest), (lead, _, same) = name.partition("_"), other.partition("_")
    return name.endswith(f"_{other}") or (first in _FOLLOWERS and lead in _LEADERS and rest == same)


def _differ(topic: Topic, other: Topic, path: Path, column: str) -> LogError:
    remedy = "keep one of the topics, for example with `ros2 bag convert` or `mcap filter`"
    return LogError(
        f"{topic.name} and {other.name} both contain this column, with different values",
        remedy,
        source=path,
        column=column,
    )


def _content(topic: Topic, names: list[str]) -> set[tuple[float, ...]]:
    """Values and times of some columns, in the order of time."""
    places = [2 + topic.columns.index(name) for name in names]
    return {(0.0 if math.isnan(row[0]) else row[0], *(row[place] for place in places)) for row in topic.rows}


def _streams(topics: list[Topic], path: Path, doubts: list[LogFinding]) -> list[Stream]:
    """Streams on one clock, with interpolated trajectories and with arrays in the order of the joints."""
    streams, clocks, taken = list[Stream](), _clocks(topics), dict[str, Topic]()
    order = sorted(zip(topics, clocks, strict=True), key=lambda item: (item[0].is_array, -len(item[0].columns)))
    for topic, time in sorted(order, key=lambda item: not item[0].ends("position")):
        values = np.array(topic.rows)[:, 2:]
        if topic.paths:
            time, values = _followed(topic, time, streams)
        columns = topic.columns
        if topic.is_array:
            columns = _order(topic, time, values, streams, taken, path, doubts)
            taken |= dict.fromkeys(columns, topic)
        keep = np.append(np.diff(time) > INSTANT, True)
        streams.append(Stream(time[keep], dict(zip(columns, values[keep].T, strict=True))))
    start = min((stream.time[0] for stream in streams), default=0.0)
    return [Stream(stream.time - start, stream.columns) for stream in streams]


def _clocks(topics: list[Topic]) -> list[np.ndarray]:
    """Times of each topic's messages: header times if all headers share a clock, otherwise bag times.

    Header times of a simulation may run at another speed than bag times. Messages without a header are converted to the
    header clock from their time of receipt.
    """
    stamps = [np.array(topic.rows)[:, :2] for topic in topics]
    stamped = [table for table in stamps if not np.isnan(table[:, 0]).any()]
    if not stamped:
        return [table[:, 1] for table in stamps]
    header, bag = max(stamped, key=len).T
    slope, offset = np.polyfit(bag - bag[0], header, 1) if np.ptp(bag) > 0 else (1.0, header[0])
    even = np.std(header - offset - slope * (bag - bag[0])) < 0.05

    def mapped(received: np.ndarray) -> np.ndarray:
        return offset + slope * (received - bag[0]) if even else np.interp(received, bag, header)

    apart = max(abs(float(np.median(table[:, 0] - mapped(table[:, 1])))) for table in stamped)
    if apart >= _SHARED:
        return [table[:, 1] for table in stamps]
    return [np.where(np.isnan(table[:, 0]), mapped(table[:, 1]), table[:, 0]) for table in stamps]


def _followed(topic: Topic, time: np.ndarray, streams: list[Stream]) -> tuple[np.ndarray, np.ndarray]:
    """Times and targets of trajectories as a controller interpolates them. Each starts at the last target, the first at
    the measured position, and ends when the next one starts."""
    order = np.argsort(time, kind="stable")
    at = {name: (s.time, values) for s in streams for name, values in s.columns.items()}
    names = [column.replace(".target", ".position") for column in topic.columns]
    first = topic.paths[order[0]][1][0]
    last = np.array([np.interp(time[order[0]], *at[n]) if n in at else first[i] for i, n in enumerate(names)])
    times, targets = [], []
    for place, following in itertools.zip_longest(order, order[1:]):
        after, goals = topic.paths[place]
        if after[0] > 0:
            after, goals = np.concatenate([[0.0], after]), np.vstack([last, goals])
        until = time[following] - time[place] if following is not None else math.inf
        end = min(float(after[-1]), until, after[0] + 3600)
        within = [*np.arange(float(after[0]), float(end), _TRAJECTORY_STEP), max(end, after[0])]
        path = np.stack([np.interp(within, after, goal) for goal in goals.T], axis=1)
        rows = slice(0, len(within) - (following is not None and end < after[-1] and len(within) > 1))
        times.append(time[place] + np.array(within)[rows])
        targets.append(path[rows])
        last = path[-1]
    return np.concatenate(times), np.concatenate(targets)


def _order(
    topic: Topic,
    time: np.ndarray,
    values: np.ndarray,
    streams: list[Stream],
    taken: Mapping[str, Topic],
    path: Path,
    doubts: list[LogFinding],
) -> tuple[str, ...]:
    """The joints of an array of targets: the joints with the nearest positions that belong to no other array.

    Raises:
        LogError: if the assignment is ambiguous.
    """
    states = {n: (s.time, values) for s in streams for n, values in s.columns.items() if n.endswith(".position")}
    names, width = [name for name in states if name.replace(".position", ".target") not in taken], values.shape[1]
    if len(names) < width:
        if taken and len(states) >= width:
            raise _differ(topic, next(iter(taken.values())), path, next(iter(taken)))
        problem = f"{topic.name} sends arrays of {width} numbers, but the states have {len(names)} joints"
        raise LogError(problem, "record a command topic with joint names", source=path)
    clock = states[names[0]][0]
    clock = clock[clock >= time[0]]
    angle = np.array([np.interp(clock, *states[name]) for name in names]).T
    targets = values[np.searchsorted(time, clock, side="right") - 1]
    if len(angle) < 20:
        return tuple(name.replace(".position", ".target") for name in names[:width])
    apart = np.median(np.abs(targets[:, :, None] - angle[:, None, :]), axis=0)
    nearest = linear_sum_assignment(apart)[1]
    number, asked = np.arange(width), np.ptp(targets, axis=0)
    in_order = width == len(states) and apart.trace() < 1.5 * apart[number, nearest].sum() + 0.01 * width
    chosen = number if in_order else nearest
    others = np.where(chosen[:, None] == np.arange(len(names)), np.inf, apart).min(1) if len(names) > 1 else asked + 1
    off = apart[number, chosen]
    unclear = (asked > 0.1) & ((off > 0.5 * asked) | ((off > 0.5 * others) & (not in_order)))
    if unclear.any():
        problem = f"{topic.name} sends arrays without joint names, and number {int(unclear.argmax()) + 1}"
        problem += " does not clearly belong to a joint"
        raise LogError(problem, "record a command topic with joint names", source=path)
    if not in_order and (chosen != number).any():
        order = ", ".join(names[at].rpartition(".")[0] for at in chosen)
        problem = f"{topic.name} sends numbers without names, which are assigned to {order}: these"
        problem += " joints follow them, although the states have another order"
        remedy = "correct the names under `columns:` if the assignment is wrong"
        doubts.append(LogFinding(WARNING, problem, remedy, check="order of joints"))
    return tuple(names[at].replace(".position", ".target") for at in chosen)
