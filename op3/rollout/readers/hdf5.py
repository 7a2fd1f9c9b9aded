"""HDF5 with named arrays [time, joint], such as episodes of ALOHA.

Numbered groups, such as `demo_0`, are separate recordings. If arrays in several groups have the same name, the arrays
of a leader are targets and the others keep the group in their name. Joint names come from the file, from ALOHA if the
number of joints agrees, or from `columns:` of the YAML. ALOHA files contain `observations/qpos`, `qvel`, `effort` and
`action` of one or two arms with six joints and a gripper, at 50 rows per second, without times. The grippers are
omitted, because they are normalised to a range from 0 to 1 that the file does not state.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.finding import WARNING, LogFinding
from op3.rollout.guess import guess_all
from op3.rollout.readers.npz import columns_of
from op3.rollout.readers.reader import Column, Recording, Stream, needed

_RATE = 50.0
"""Rows per second of ALOHA's recordings."""

_ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
_TIMES = ("time", "times", "timestamp", "timestamps", "t")
_NAMES = ("joints", "joint_names", "names")
_LEADERS = ("leader", "master")


class Hdf5:
    """A file of named arrays."""

    title = "HDF5, also of ALOHA (needs op3[hdf5])"
    paths = "<name>.hdf5, <name>.h5"

    def claims(self, path: Path) -> bool:
        """Recognised by the file name extension."""
        return path.is_file() and path.suffix in (".hdf5", ".h5")

    def read(self, path: Path) -> list[Recording]:
        """One recording, or one recording per numbered group."""
        arrays, about = _content(path)
        episodes = _episodes(arrays)
        return [_recording(content, about, name and f"{path.stem}/{name}", path) for name, content in episodes.items()]


def _recording(content: dict[str, np.ndarray], about: dict[str, Any], name: str, path: Path) -> Recording:
    long = [len(array) for array in content.values() if array.ndim == 2]
    rows = max(set(long), key=long.count, default=0)
    if rows < 2:
        raise LogError("there are no arrays with several rows", "save arrays [time, joint]", source=path)
    doubts: list[LogFinding] = []
    time = next((content.pop(n).reshape(-1) for n in _TIMES if n in content), None)
    if time is None:
        rate = next((float(about[n]) for n in ("fps", "rate", "hz") if _positive(about.get(n))), 0.0)
        if not rate:
            rate = _RATE
            problem = f"the file has no times, so {_RATE:g} rows per second are assumed, as ALOHA records"
            remedy = "save `time` [s], or an attribute `fps`"
            doubts.append(LogFinding(WARNING, problem, remedy, "time", check="times"))
        time = np.arange(rows) / rate
    width = next((array.shape[1] for name, array in content.items() if name == "qpos"), 0)
    joints = [str(one) for name in _NAMES for one in np.atleast_1d(about.get(name, []))]
    if not joints and width in (len(_ARM), 2 * len(_ARM)):
        sides = ("left_", "right_") if width > len(_ARM) else ("",)
        joints = [f"{side}{joint}" for side in sides for joint in _ARM]
    content = {name: array for name, array in content.items() if len(array) == rows and array.ndim <= 2}
    columns = columns_of(content, rows, joints, path)
    meanings = guess_all(columns, joints)
    for column, values in columns.items():
        gripper = str(meanings[column].name).rpartition(".")[0].endswith("gripper")
        if gripper and values.min() > -0.5 and values.max() < 1.5:
            meanings[column] = Column(None, why="normalised from 0 to 1 by a range that the file does not state")
    metadata = {"robot": "simulated" if about.get("sim") else "real", "mount": "stand"}
    return Recording([Stream(time.astype(float), columns)], metadata, meanings, name, doubts=doubts)


def _episodes(arrays: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Arrays by name, for each numbered group; the group is "" if there is none."""
    episodes: dict[str, dict[str, np.ndarray]] = {}
    twice = Counter(name.rpartition("/")[2] for name in arrays)
    for name, array in arrays.items():
        *groups, short = name.split("/")
        numbered = [at for at, group in enumerate(groups, 1) if re.search(r"\d$", group)] if twice[short] > 1 else []
        episode = "/".join(groups[: numbered[-1]]) if numbered else ""
        inner = groups[numbered[-1] :] if numbered else groups
        episodes.setdefault(episode, {})[_within(inner, short, episodes.get(episode, {}))] = array
    shared = episodes.pop("", {}) if len(episodes) > 1 else {}
    return {episode: {**shared, **content} for episode, content in episodes.items()}


def _within(groups: list[str], short: str, taken: Collection[str]) -> str:
    """The name of an array in groups: a target for a leader; prefixed with the group if the name is taken."""
    if any(word in group.lower() for group in groups for word in _LEADERS):
        return f"target_{short}"
    return "_".join([*groups, short]) if short in taken else short


def _positive(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and float(value) > 0


def _content(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Numeric arrays by path, and attributes and texts; images are skipped."""
    h5py = needed("h5py", "hdf5", path)
    arrays: dict[str, np.ndarray] = {}
    about: dict[str, Any] = {}

    def take(name: str, item: Any) -> None:
        about.update(item.attrs)
        if not isinstance(item, h5py.Dataset):
            return
        short = name.rpartition("/")[2]
        if item.ndim == 1 and item.dtype.kind in "SUO":
            about[short] = [one.decode() if isinstance(one, bytes) else str(one) for one in item[()]]
        elif item.ndim in (1, 2) and item.dtype.kind in "fiub":
            arrays[name] = np.asarray(item[()], dtype=float)

    try:
        with h5py.File(path, "r") as file:
            about.update(file.attrs)
            file.visititems(take)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, MemoryError) as error:
        said = " ".join(str(error).split())[:120]
        raise LogError(f"the file is not readable HDF5 ({said})", "copy the file again", source=path) from None
    return arrays, about
