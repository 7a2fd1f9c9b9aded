"""One page for several runs of an experiment, with results by the settings that differ."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import plotly.graph_objects as go
import yaml

from op3.common.plain_names import words
from op3.common.sample_intervals import mean_and_deviation
from op3.report.page import Page
from op3.report.result import read_result, write_result
from op3.report.style import NAMES, bars_figure, curves_figure
from op3.report.tables import Cell, TableRows

PAGE, NUMBERS = "comparison.html", "comparison.yaml"

QUANTITIES = NAMES["compared"]
HIGHER = ("evaluation.", "probability")
"""Measures of which higher values are better."""

MOST = 8
"""Numbers compared if runs have none of the measures above."""

FOUND = ("parameters.", "normalised.")
"""Prefixes of the keys of identified parameters."""

_STORES = ("hydra.sweep", "hydra.sweeper.storage", "hydra.sweeper.study_name", "hydra.run", "population")
"""Overrides that only set where a run stores its files."""


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """One finished run: the name of its folder, overrides by key, and the numbers of its `result.yaml`."""

    name: str
    settings: Mapping[str, str]
    numbers: Mapping[str, Any]


def read_runs(folder: str | Path) -> list[ComparedRun]:
    """All finished runs directly in a folder, by name.

    Raises:
        ValueError: if the folder contains no finished run.
    """
    cells = [path.parent for path in Path(folder).glob("*/result.yaml")]
    if not cells:
        raise ValueError(f"{folder} contains no run with a result.yaml; give the folder of a multirun")
    cells.sort(key=lambda cell: (not cell.name.isdigit(), int(cell.name) if cell.name.isdigit() else 0, cell.name))
    return [ComparedRun(cell.name, _settings(cell), read_result(cell / "result.yaml")) for cell in cells]


def _settings(cell: Path) -> dict[str, str]:
    """Overrides as Hydra keeps them beside the run."""
    path = cell / ".hydra" / "overrides.yaml"
    overrides = yaml.safe_load(path.read_text()) if path.is_file() else []
    pairs = [override.lstrip("+~").partition("=") for override in overrides or []]
    return {key: value for key, _, value in pairs if not key.startswith(_STORES)}


def varied(runs: Sequence[ComparedRun]) -> list[str]:
    """Keys in which the runs differ; the seed last."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    differing = (key for key in keys if len({run.settings.get(key) for run in runs}) > 1)
    return sorted(differing, key=lambda key: key == "seed")


def variants(runs: Sequence[ComparedRun]) -> dict[str, list[ComparedRun]]:
    """The runs grouped by all differing settings except the seed."""
    keys, found = [key for key in varied(runs) if key != "seed"], {}
    for run in runs:
        name = ", ".join(f"{key}={run.settings.get(key, 'default')}" for key in keys)
        found.setdefault(name or "all runs", []).append(run)
    return found


def quantities(runs: Sequence[ComparedRun]) -> dict[str, str]:
    """Compared numbers with their columns: known measures of these runs, otherwise the first numbers."""
    has = dict.fromkeys(key for run in runs for key, value in run.numbers.items() if isinstance(value, int | float))
    known = {key: title for key, title in QUANTITIES.items() if key in has}
    return known if set(known) - {"wall_seconds"} else {key: words(key.replace(".", " ")) for key in list(has)[:MOST]}


def write_comparison(runs: Sequence[ComparedRun], folder: str | Path) -> tuple[Path, Path]:
    """Write page and numbers of a comparison of at least one run into a folder; returns their paths.

    Runs that differ only in the seed form one variant, for which means and standard deviations are computed.
    """
    folder, groups, columns = Path(folder), variants(runs), quantities(runs)
    entries = [_entry(name, members, columns) for name, members in groups.items()]
    first = next(iter(columns), None)
    sign = -1.0 if first is not None and first.startswith(HIGHER) else 1.0
    entries.sort(key=lambda e: sign * e[first]["value"] if first is not None and e[first] else math.inf)
    result = write_result(folder / NUMBERS, {"runs": len(runs), "variants": entries}, NAMES["meanings"]["comparison"])
    figures = {"runs": _runs_figure(runs, columns, entries), "places": _places_figure(entries)}
    by = columns[first].partition(" [")[0] if first is not None else ""
    context = {"runs": runs, "variants": entries, "by": by, "numbers": NUMBERS}
    return Page.of("comparison", figures, _tables(runs, columns, entries), **context).write(folder / PAGE), result


def _entry(name: str, members: Sequence[ComparedRun], columns: Mapping[str, str]) -> dict[str, Any]:
    parameters = dict.fromkeys(key for run in members for key in run.numbers if key.startswith(FOUND))
    return {
        "variant": name,
        "runs": [run.name for run in members],
        **{
            key: mean_and_deviation([_value(run.numbers.get(key)) for run in members])
            for key in (*columns, *parameters)
        },
    }


def _value(estimate: Any) -> float | None:
    return estimate["value"] if isinstance(estimate, Mapping) else estimate


def _cells(found: Mapping[str, Any] | None) -> list[Cell]:
    """Mean and deviation as two cells of a table."""
    return [None, None] if found is None else [found["value"], found["deviation"]]


def _found(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(key for entry in entries for key in entry if key.startswith(FOUND)))


def _tables(
    runs: Sequence[ComparedRun], columns: Mapping[str, str], entries: Sequence[Mapping[str, Any]]
) -> dict[str, TableRows]:
    keys = varied(runs)
    return {
        "variants": (
            ["variant", "runs", *(part for title in columns.values() for part in (title, "±"))],
            [[e["variant"], len(e["runs"]), *(c for key in columns for c in _cells(e[key]))] for e in entries],
        ),
        "parameters": (
            ["parameter", *(part for entry in entries for part in (entry["variant"], "±")), "remark"],
            [
                [words(n.replace(".", " ")), *(c for e in entries for c in _cells(e.get(key))), _remark(runs, n)]
                for key in _found(entries) for n in (key.removeprefix("parameters."),)
            ],
        ),
        "runs": (
            ["run", *keys, *columns.values()],
            [[r.name, *(r.settings.get(k, "default") for k in keys), *map(r.numbers.get, columns)] for r in runs],
        ),
    }  # fmt: skip


def _remark(runs: Sequence[ComparedRun], parameter: str) -> str:
    """Text with the number of runs whose search ended at a bound of a parameter's range."""
    ended = sum(parameter in (run.numbers.get("identifiability.at_bound") or ()) for run in runs)
    return f"at its bound in {ended} of {len(runs)} runs" if ended else ""


def _runs_figure(
    runs: Sequence[ComparedRun], columns: Mapping[str, str], entries: Sequence[Mapping[str, Any]]
) -> go.Figure | None:
    """Every run plotted by the first two compared numbers; None if there is only one."""
    if len(columns) < 2:
        return None
    (x, x_title), (y, y_title) = list(columns.items())[1::-1]
    of = {run.name: run.numbers for run in runs}
    points = {}
    for entry in entries:
        pairs = [(of[name].get(x), of[name].get(y)) for name in entry["runs"]]
        points[entry["variant"]] = tuple(zip(*(pair for pair in pairs if None not in pair), strict=True)) or ([], [])
    x_title, y_title = (title if "[" in title else f"{title} [-]" for title in (x_title, y_title))
    return curves_figure(points, x_title, y_title, 380, "markers")


def _places_figure(entries: Sequence[Mapping[str, Any]]) -> go.Figure | None:
    """Re-identified parameters within their ranges; None for other runs."""
    places = [name for name in _found(entries) if name.startswith("normalised.reidentified.")]
    bars, spreads = (
        {e["variant"]: {n.split(".", 2)[2]: e[n][part] or 0.0 for n in places if e.get(n)} for e in entries}
        for part in ("value", "deviation")
    )
    return bars_figure(bars, "share of the range [-]", spreads) if places else None
