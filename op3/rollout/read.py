"""Reads logs of any format: a single log, or all logs in a folder, pattern or list."""

from __future__ import annotations

import difflib
import glob
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from op3.robot.robot import Robot, load_robot
from op3.rollout.errors import LogError
from op3.rollout.importing import read_side, roll_out, side_path
from op3.rollout.readers import readers
from op3.rollout.readers.reader import Reader, Recording
from op3.rollout.robot_log import as_robot
from op3.rollout.rollout import METADATA_FILE, Rollout

Paths = str | Path | Iterable[str | Path]


def kinds() -> str:
    """The kinds of paths that can be read, as text."""
    return "a rollout folder, a wide .csv with its sidecar, " + ", ".join(
        f"{reader.title} ({reader.paths})" for name, reader in readers().items() if name not in ("folder", "csv")
    )


def read_log(path: str | Path, robot: str | Path | Robot | None = None) -> Rollout:
    """Read a log of any format that contains one recording.

    Args:
        path: path of the log.
        robot: name or file of the robot, for a log that names none; see `as_robot`.

    Raises:
        LogError: if the log is invalid; the message is one sentence.
    """
    logs = read_episodes(path, robot=robot)
    if len(logs) == 1:
        return logs[0]
    remedy = "read them all with read_logs, or give the path to `data=`"
    raise LogError(f"it contains {len(logs)} recordings", remedy, source=path)


def read_episodes(
    path: str | Path,
    options: Mapping[str, Any] | None = None,
    check: bool = True,
    robot: str | Path | Robot | None = None,
    proposed: Mapping[str, Any] | None = None,
) -> list[Rollout]:
    """All recordings in one log.

    Args:
        path: File or folder of the log.
        options: Options of the import, which override its YAML; see `op3.rollout.importing.Options`.
        check: Whether to reject impossible logs and to exclude unusable channels of single joints.
        robot: Robot that made the log, see `read_log`.
        proposed: Content of the YAML for a log without one.
    """
    path = Path(path)
    logs: list[Rollout] = []
    asked = [name for name, value in (options or {}).items() if value not in (None, False)]
    for found in reader_of(path).read(path):
        if isinstance(found, Rollout) and asked:
            problem = f"a rollout folder is read unchanged, so {asked[0]} does not apply"
            raise LogError(problem, "import the log that it was made from, or omit the option", source=path)
        logs += roll_out(found, read_side(path, options, proposed), path) if isinstance(found, Recording) else [found]
    if not logs:
        raise LogError("it contains no recording", "record at least one episode", source=path)
    if robot is not None:
        known = load_robot(robot)
        for number, log in enumerate(logs):
            if log.metadata.robot_file not in (None, known.reference):
                problem = f"the log belongs to the robot {log.metadata.robot_file!r}, not to {known.reference!r}"
                raise LogError(problem, "omit robot=, or correct the field", source=path, column="field robot_file")
            logs[number] = log if log.metadata.robot_file else as_robot(log, known)
    said = next((file for file in (side_path(path), path / METADATA_FILE) if file.is_file()), None)
    return [log.check(path, said) for log in logs] if check else logs


def read_logs(paths: Paths, robot: str | Path | Robot | None = None) -> list[Rollout]:
    """Read many logs, sorted by path.

    Args:
        paths: A log, a folder of logs (directly in it, or otherwise in its subfolders, as a multirun writes them), a
            glob pattern (`logs/**/*.csv`), or several of these, whose order is kept. In a folder, files without a
            recording are skipped.
        robot: robot that made the logs, see `read_log`.
    """
    given = [paths] if isinstance(paths, str | Path) else paths
    logs = [log for entry in given for path in expand(entry) for log in read_episodes(path, robot=robot)]
    if not logs:
        raise LogError("the list of logs is empty", f"name {kinds()}")
    return logs


def robot_of(paths: Paths) -> Robot:
    """The robot of the first of these logs, see `read_logs`."""
    first = paths if isinstance(paths, str | Path) else next(iter(paths))
    return read_episodes(expand(first)[0])[0].robot


def expand(path: str | Path) -> list[Path]:
    """Paths of the single logs in a path, folder or pattern."""
    if not str(path).strip():
        raise LogError("the path of a log is empty", f"name {kinds()}")
    path = Path(path)
    if path.is_dir() and _claiming(path) is None:
        found, where = _inside(path), "the folder contains no log"
    elif path.exists() or not glob.has_magic(str(path)):
        return [path]
    else:
        matched = [Path(name) for name in sorted(glob.glob(str(path), recursive=True))]
        found = [entry for entry in matched if _is_log(entry)] or matched  # if none is a log, the error names the first
        where = "no file matches the pattern"
    if not found:
        raise LogError(where, f"name a folder or pattern with {kinds()}", source=path)
    return found


def reader_of(path: Path) -> Reader:
    """The reader of a log; raises `LogError` if no reader supports it."""
    reader = _claiming(path) if path.exists() else None
    if reader is None:
        problem = (
            f"no {METADATA_FILE} in this folder" if path.is_dir() else f"the ending {path.suffix!r} is not a log format"
        )
        if not path.exists():
            there = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
            named = [str(path.parent / name) for name in difflib.get_close_matches(path.name, there, n=1)]
            remedy = f"correct the path if you mean {named[0]}" if named else "correct the path of the log"
            raise LogError("there is no such file or folder", remedy, source=path)
        raise LogError(problem, f"name {kinds()}", source=path)
    return reader


def _claiming(path: Path) -> Reader | None:
    """The first reader that claims an existing path."""
    return next((reader for reader in readers().values() if reader.claims(path)), None)


def _inside(folder: Path) -> list[Path]:
    """Logs directly in a folder; if there are none, the logs in its subfolders."""
    entries = sorted(folder.iterdir())
    found = [entry for entry in entries if _is_log(entry)]
    if found:
        return found
    return [log for entry in entries if entry.is_dir() and entry.name[0] != "." for log in _inside(entry)]


def _is_log(path: Path) -> bool:
    reader = None if path.name.startswith(".") or path.name == METADATA_FILE else _claiming(path)
    return reader is not None and getattr(reader, "holds", lambda _: True)(path)
