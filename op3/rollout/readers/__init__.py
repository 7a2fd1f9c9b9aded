"""Readers of log formats: one module per format, and entry points of other packages."""

from __future__ import annotations

import functools
from importlib import import_module
from importlib.metadata import entry_points

from op3.rollout.readers.reader import Reader

_OURS = {
    "folder": "folder:Folder",
    "sage": "sage:Sage",  # before CSV, because its parts are CSV files
    "csv": "csv_table:CsvTable",
    "servo_bench": "servo_bench:ServoBench",
    "lerobot": "lerobot:LeRobot",
    "ros": "ros:Ros",
    "npz": "npz:Npz",
    "hdf5": "hdf5:Hdf5",
}


@functools.cache
def readers() -> dict[str, Reader]:
    """All readers by name; readers of other packages come first, so that they can claim a path first."""
    found: dict[str, Reader] = {entry.name: entry.load()() for entry in entry_points(group="op3.readers")}
    for name, place in _OURS.items():
        module, _, kind = place.partition(":")
        found.setdefault(name, getattr(import_module(f"{__name__}.{module}"), kind)())
    return found


def formats_table() -> str:
    """The formats as Markdown, for documentation."""
    lines = ["| format | name | `data=` |", "|---|---|---|"]
    lines += [f"| {r.title} | {name} | `{r.paths}` |" for name, r in sorted(readers().items())]
    return "\n".join(lines) + "\n"
