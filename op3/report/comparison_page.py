"""One page for several runs of one experiment: what they found, by what they differ in."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from op3.report.page import Page
from op3.report.result import read_result, write_result
from op3.report.style import bars_figure, curves_figure, words
from op3.report.tables import Cell

PAGE, NUMBERS = "comparison.html", "comparison.yaml"

QUANTITIES: Mapping[str, str] = {
    "error_mrad.heldout": "held-out error [mrad]",
    "error_mrad.train": "error [mrad]",
    "loss.heldout": "held-out loss",
    "loss.paper_eq7": "paper eq. (7)",
    "loss.fit": "loss",
    "evaluation.return_mean": "mean return",
    "evaluation.return": "return",
    "evaluation.success": "success",
    "evaluation.upright": "upright",
    "distance.ratio": "distance of returns, re-identified by excitation only",
    "fresh.ratio": "the same over fresh episodes",
    "excitation.ratio": "excitation loss, re-identified by excitation only",
    "gap.joint/position.after": "gap in angle [rad]",
    "probability": "probability",
    "simulated_seconds": "simulated [s]",
    "wall_seconds": "time [s]",
}
"""Numbers of a run's `result.yaml` that are compared, where they are there, and their columns; the first orders."""

HIGHER = ("evaluation.", "probability")
"""What is the better the higher it is."""

MOST = 8
"""Numbers that are compared of runs that have none of these."""

FOUND = ("parameters.", "normalised.")
"""Beginnings of the keys of what was found."""

_STORES = ("hydra.sweep", "hydra.sweeper.storage", "hydra.sweeper.study_name", "hydra.run", "population")
"""Overrides that only say where a run stores things."""


@dataclass(frozen=True, eq=False)
class Run:
    """One finished run.

    Attributes:
        name: of its folder.
        settings: overrides of its command line by key.
        numbers: of its `result.yaml`.
    """

    name: str
    settings: Mapping[str, str]
    numbers: Mapping[str, Any]


def read_runs(folder: str | Path) -> list[Run]:
    """All finished runs directly in a folder, by name.

    Raises:
        ValueError: if there is none.
    """
    cells = [path.parent for path in Path(folder).glob("*/result.yaml")]
    if not cells:
        raise ValueError(f"{folder} holds no run with a result.yaml; name the folder of a multirun")
    cells.sort(key=lambda cell: (not cell.name.isdigit(), int(cell.name) if cell.name.isdigit() else 0, cell.name))
    return [Run(cell.name, _settings(cell), read_result(cell / "result.yaml")) for cell in cells]


def _settings(cell: Path) -> dict[str, str]:
    """Overrides as Hydra keeps them beside the run."""
    path = cell / ".hydra" / "overrides.yaml"
    overrides = yaml.safe_load(path.read_text()) if path.is_file() else []
    pairs = [override.lstrip("+~").partition("=") for override in overrides or []]
    return {key: value for key, _, value in pairs if not key.startswith(_STORES)}


def varied(runs: Sequence[Run]) -> list[str]:
    """Keys in which the runs differ; the seed last."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    differing = [key for key in keys if len({run.settings.get(key) for run in runs}) > 1]
    return sorted(differing, key=lambda key: key == "seed")


def variants(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """The runs by what they differ in but the seed."""
    keys, found = [key for key in varied(runs) if key != "seed"], {}
    for run in runs:
        name = ", ".join(f"{key}={run.settings.get(key, 'default')}" for key in keys)
        found.setdefault(name or "all runs", []).append(run)
    return found


def quantities(runs: Sequence[Run]) -> dict[str, str]:
    """What is compared, with its column: what is known of these runs, else their first numbers."""
    has = dict.fromkeys(key for run in runs for key, value in run.numbers.items() if _is_number(value))
    known = {key: title for key, title in QUANTITIES.items() if key in has}
    return known if set(known) - {"wall_seconds"} else {key: words(key.replace(".", " ")) for key in list(has)[:MOST]}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


def spread(values: Sequence[float | None]) -> dict[str, Any] | None:
    """Mean and standard deviation; None where no run has the number, no deviation of a single one."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return None
    deviation = float(np.std(known, ddof=1)) if len(known) > 1 else None
    return {"value": float(np.mean(known)), "deviation": deviation, "count": len(known)}


def spread_cells(found: Mapping[str, Any] | None) -> list[Cell]:
    """Mean and deviation as two cells of a table."""
    return [None, None] if found is None else [found["value"], found["deviation"]]


def write_comparison(runs: Sequence[Run], folder: str | Path) -> tuple[Path, Path]:
    """Write page and numbers of a comparison.

    Runs that differ in nothing but the seed are one variant: means and standard deviations are taken over them.

    Args:
        runs: at least one.
        folder: where `comparison.html` and `comparison.yaml` shall be.

    Returns:
        Their paths.
    """
    folder, groups, columns = Path(folder), variants(runs), quantities(runs)
    entries = [_entry(name, members, columns) for name, members in groups.items()]
    first = next(iter(columns), None)
    sign = -1.0 if first is not None and first.startswith(HIGHER) else 1.0
    entries.sort(key=lambda e: sign * e[first]["value"] if first is not None and e[first] else math.inf)
    meanings = {"variants": "runs that differ in the seed alone; spread is the standard deviation over seeds"}
    result = write_result(folder / NUMBERS, {"runs": len(runs), "variants": entries}, meanings)
    return _page(runs, columns, entries).write(folder / PAGE), result


def _entry(name: str, members: Sequence[Run], columns: Mapping[str, str]) -> dict[str, Any]:
    parameters = dict.fromkeys(key for run in members for key in run.numbers if key.startswith(FOUND))
    return {
        "variant": name,
        "runs": [run.name for run in members],
        **{key: spread([run.numbers.get(key) for run in members]) for key in columns},
        **{key: spread([_value(run.numbers[key]) for run in members if key in run.numbers]) for key in parameters},
    }


def _value(estimate: Any) -> float:
    return float(estimate["value"]) if isinstance(estimate, Mapping) else float(estimate)


def _page(runs: Sequence[Run], columns: Mapping[str, str], entries: Sequence[Mapping[str, Any]]) -> Page:
    keys, count = varied(runs), len(entries)
    lead = f"{len(runs)} runs of {count} variant{'s' if count > 1 else ''}."
    if count > 1 and columns:
        by = next(iter(columns.values())).partition(" [")[0]
        lead = f"Best by the {by}: {entries[0]['variant']}. {lead}"
    page = Page("Comparison of runs", lead)
    page.section("Variants")
    header = ["variant", "runs", *(part for title in columns.values() for part in (title, "±"))]
    rows = [[e["variant"], len(e["runs"]), *(c for key in columns for c in spread_cells(e[key]))] for e in entries]
    page.table(header, rows, caption="Mean and standard deviation over seeds, best first.")
    if len(columns) > 1:
        (x, x_title), (y, y_title) = list(columns.items())[1::-1]
        of = {run.name: run.numbers for run in runs}
        shown = {e["variant"]: [(of[n].get(x), of[n].get(y)) for n in e["runs"]] for e in entries}
        kept = {name: [pair for pair in pairs if None not in pair] for name, pairs in shown.items()}
        points = {name: ([a for a, _ in pairs], [b for _, b in pairs]) for name, pairs in kept.items()}
        x_title, y_title = (title if "[" in title else f"{title} [-]" for title in (x_title, y_title))
        page.figure(curves_figure(points, x_title, y_title, 380, "markers"), "Every run.")
    names = list(dict.fromkeys(key for entry in entries for key in entry if key.startswith(FOUND)))
    if names:
        page.section("Parameters")
        header = ["parameter", *(part for entry in entries for part in (entry["variant"], "±"))]
        named = [
            [
                words(n.removeprefix("parameters.").replace(".", " ")),
                *(c for e in entries for c in spread_cells(e.get(n))),
            ]
            for n in names
        ]
        page.table(header, named, caption="Values found, and how they differ between seeds.")
        places = [name for name in names if name.startswith("normalised.reidentified.")]
        if places:
            known = {e["variant"]: {n.split(".", 2)[2]: e[n] for n in places if e.get(n)} for e in entries}
            bars, spreads = (
                {label: {n: one[part] or 0.0 for n, one in by.items()} for label, by in known.items()}
                for part in ("value", "deviation")
            )
            figure = bars_figure(bars, "share of the range [-]", spreads)
            page.figure(figure, "Re-identified parameters normalised by Table I: mean and deviation over seeds.")
    page.section("Runs")
    rows = [
        [run.name, *(run.settings.get(key, "default") for key in keys), *(run.numbers.get(k) for k in columns)]
        for run in runs
    ]
    page.table(["run", *keys, *columns.values()], rows, caption="Every run.")
    page.files({f"{run.name}/index.html": f"run {run.name}" for run in runs} | {NUMBERS: "all numbers of this page"})
    return page
