"""Reading logs of any kind: rollout folders, wide CSV, servo-bench JSON."""

from __future__ import annotations

import glob
from collections.abc import Iterable
from pathlib import Path

from op3.rollout.csv_log import read_csv
from op3.rollout.errors import LogError
from op3.rollout.rollout import METADATA_FILE, Rollout
from op3.rollout.servo_bench import looks_like_servo_bench, read_servo_bench

_KINDS = "a rollout folder, a wide .csv with its sidecar, or a servo-bench .json or .json.xz"


def read_log(path: str | Path) -> Rollout:
    """Read one log: a rollout folder, a wide `.csv` with its sidecar, or servo-bench `.json` / `.json.xz`.

    Raises `LogError` with one sentence, and imports nothing, if anything about it is wrong.
    """
    path = Path(path)
    if path.is_dir():
        return Rollout.load(path)
    if not path.exists():
        raise LogError("there is no such file", f"name {_KINDS}", source=path)
    if path.suffix == ".csv":
        return read_csv(path)
    if path.suffix == ".json" or path.suffixes[-2:] == [".json", ".xz"]:
        return read_servo_bench(path)
    if path.name == METADATA_FILE:
        return Rollout.load(path.parent)
    raise LogError(f"the ending {path.suffix!r} is not a log's", f"name {_KINDS}", source=path)


def read_logs(paths: str | Path | Iterable[str | Path]) -> list[Rollout]:
    """Read many logs, sorted by path.

    Args:
        paths: A log, a folder of logs (rollout folders, CSV files and servo-bench JSON directly in it; where there are
            none, in the folders in it, as a multirun leaves them), a glob pattern (`logs/**/*.csv`), or several of
            these, whose order is kept. In a folder, JSON files that hold no recording are passed over.
    """
    if isinstance(paths, str | Path):
        found = _expand(paths)
        return [read_log(path) for path in found]
    logs = [log for path in paths for log in read_logs(path)]
    if not logs:
        raise LogError("the list of logs is empty", f"name {_KINDS}")
    return logs


def _expand(path: str | Path) -> list[Path]:
    """The single logs that a path, folder or pattern stands for."""
    path = Path(path)
    if path.is_dir() and not (path / METADATA_FILE).is_file():
        found = _inside(path)
        where = "the folder holds no log"
    elif path.exists() or not glob.has_magic(str(path)):
        return [path]
    else:
        matched = [Path(name) for name in sorted(glob.glob(str(path), recursive=True))]
        found = [entry for entry in matched if _is_log(entry)] or matched  # of files that are none the first is named
        where = "no file matches the pattern"
    if not found:
        raise LogError(where, f"name a folder or pattern with {_KINDS}", source=path)
    return found


def _inside(folder: Path) -> list[Path]:
    """Logs directly in a folder; where there are none, those of the folders in it."""
    entries = sorted(folder.iterdir())
    found = [entry for entry in entries if _is_log(entry)]
    if found:
        return found
    return [log for entry in entries if entry.is_dir() and entry.name[0] != "." for log in _inside(entry)]


def _is_log(path: Path) -> bool:
    if path.name.startswith("."):
        return False
    if path.is_dir():
        return (path / METADATA_FILE).is_file()
    if path.suffix == ".json" or path.suffixes[-2:] == [".json", ".xz"]:
        return looks_like_servo_bench(path)
    return path.suffix == ".csv"
