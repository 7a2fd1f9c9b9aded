"""One page for several runs: losses, held-out errors, parameters and time side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
import yaml

from op3.report.page import Page
from op3.report.result import read_result, write_result
from op3.report.style import curves_figure, words
from op3.report.tables import Cell

PAGE, NUMBERS = "comparison.html", "comparison.yaml"

QUANTITIES: Mapping[str, str] = {
    "loss.fit": "loss",
    "loss.heldout": "held-out loss",
    "loss.paper_eq7": "paper eq. (7)",
    "error_mrad.train": "error [mrad]",
    "error_mrad.heldout": "held-out error [mrad]",
    "simulated_seconds": "simulated [s]",
    "wall_seconds": "time [s]",
}
"""Numbers of a run's `result.yaml` that are compared, and their columns."""

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
        raise ValueError(f"{folder} holds no run with a result.yaml; name the folder of a multirun of identify.py")
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
    folder = Path(folder)
    groups = variants(runs)
    entries = sorted((_entry(name, members) for name, members in groups.items()), key=_score)
    meanings = {"variants": "runs that differ in the seed alone; spread is the standard deviation over seeds"}
    result = write_result(folder / NUMBERS, {"runs": len(runs), "variants": entries}, meanings)
    return _page(runs, groups, entries).write(folder / PAGE), result


def _entry(name: str, members: Sequence[Run]) -> dict[str, Any]:
    parameters = dict.fromkeys(key for run in members for key in run.numbers if key.startswith("parameters."))
    return {
        "variant": name,
        "runs": [run.name for run in members],
        **{key: spread([run.numbers.get(key) for run in members]) for key in QUANTITIES},
        **{key: spread([_value(run.numbers[key]) for run in members if key in run.numbers]) for key in parameters},
    }


def _value(estimate: Any) -> float:
    return float(estimate["value"]) if isinstance(estimate, Mapping) else float(estimate)


def _score(entry: Mapping[str, Any]) -> float:
    """What variants are ordered by: the held-out error where there is one, else the paper's loss."""
    keys = ("error_mrad.heldout", "loss.paper_eq7", "loss.fit")
    return next((entry[key]["value"] for key in keys if entry.get(key) is not None), float("inf"))


def _page(runs: Sequence[Run], groups: Mapping[str, Sequence[Run]], entries: Sequence[Mapping[str, Any]]) -> Page:
    best, keys = entries[0], varied(runs)
    lead = f"{len(runs)} runs of {len(groups)} {'variant' if len(groups) == 1 else 'variants'}."
    if len(groups) > 1:
        by = "held-out error" if best["error_mrad.heldout"] is not None else "loss"
        lead = f"Best by the {by}: {best['variant']}. {lead}"
    page = Page("Comparison of identifications", lead)
    page.section("Variants")
    header = ["variant", "runs", *(part for title in QUANTITIES.values() for part in (title, "±"))]
    rows = [[e["variant"], len(e["runs"]), *(c for key in QUANTITIES for c in spread_cells(e[key]))] for e in entries]
    page.table(header, rows, caption="Mean and standard deviation over seeds, best first.")
    page.figure(_figure(groups), "Every run: on the logs fitted and on those held out.")
    page.section("Parameters")
    names = list(dict.fromkeys(key for entry in entries for key in entry if key.startswith("parameters.")))
    header = ["parameter", *(part for entry in entries for part in (entry["variant"], "±"))]
    rows = [
        [words(n.removeprefix("parameters.")), *(c for e in entries for c in spread_cells(e.get(n)))] for n in names
    ]
    page.table(header, rows, caption="Values found, and how they differ between seeds.")
    page.section("Runs")
    header = ["run", *keys, *QUANTITIES.values()]
    rows = [
        [run.name, *(run.settings.get(key, "default") for key in keys), *(run.numbers.get(k) for k in QUANTITIES)]
        for run in runs
    ]
    page.table(header, rows, caption="Every run.")
    page.files({f"{run.name}/index.html": f"run {run.name}" for run in runs} | {NUMBERS: "all numbers of this page"})
    return page


def _figure(groups: Mapping[str, Sequence[Run]]) -> go.Figure:
    """Fitted against held-out error of every run; without held-out logs, the paper's loss."""
    held = any(run.numbers.get("error_mrad.heldout") is not None for members in groups.values() for run in members)
    axes = {"error_mrad.train": "error on fitted logs [mrad]", "error_mrad.heldout": "error on held-out logs [mrad]"}
    (x, x_title), (y, y_title) = (
        axes if held else {"wall_seconds": "time [s]", "loss.paper_eq7": "paper eq. (7) [-]"}
    ).items()
    shown = {
        name: [run.numbers for run in members if None not in (run.numbers.get(x), run.numbers.get(y))]
        for name, members in groups.items()
    }
    points = {name: ([n[x] for n in numbers], [n[y] for n in numbers]) for name, numbers in shown.items()}
    return curves_figure(points, x_title, y_title, 380, mode="markers")
