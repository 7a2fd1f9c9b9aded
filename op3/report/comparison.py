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
from op3.report.style import colours, dress, plain, words
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
    folder = Path(folder)
    cells = [path.parent for path in folder.glob("*/result.yaml")]
    if not cells:
        raise ValueError(f"{folder} holds no run with a result.yaml; name the folder of a multirun of identify.py")
    cells.sort(key=lambda cell: (not cell.name.isdigit(), int(cell.name) if cell.name.isdigit() else 0, cell.name))
    return [Run(cell.name, _settings(cell), read_result(cell / "result.yaml")) for cell in cells]


def _settings(cell: Path) -> dict[str, str]:
    """Overrides as Hydra keeps them beside the run, but for where it stores things."""
    path = cell / ".hydra" / "overrides.yaml"
    overrides = yaml.safe_load(path.read_text()) if path.is_file() else []
    pairs = [override.lstrip("+~").partition("=") for override in overrides or []]
    own = ("hydra.sweep", "hydra.sweeper.storage", "hydra.sweeper.study_name", "hydra.run", "population")
    return {key: value for key, _, value in pairs if not key.startswith(own)}


def varied(runs: Sequence[Run]) -> list[str]:
    """Keys in which the runs differ; the seed last."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    differing = [key for key in keys if len({run.settings.get(key) for run in runs}) > 1]
    return sorted(differing, key=lambda key: key == "seed")


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
    keys = varied(runs)
    variants: dict[str, list[Run]] = {}
    for run in runs:
        name = ", ".join(f"{key}={run.settings.get(key, 'default')}" for key in keys if key != "seed")
        variants.setdefault(name or "all runs", []).append(run)
    entries = [_entry(name, members) for name, members in variants.items()]
    order = sorted(entries, key=lambda entry: _score(entry))
    meanings = {"variants": "runs that differ in the seed alone; spread is the standard deviation over seeds"}
    result = write_result(folder / NUMBERS, {"runs": len(runs), "variants": order}, meanings)
    page = _page(runs, keys, variants, order)
    return page.write(folder / PAGE), result


def _entry(name: str, members: Sequence[Run]) -> dict[str, Any]:
    entry: dict[str, Any] = {"variant": name, "runs": [run.name for run in members]}
    for key in QUANTITIES:
        entry[key] = _spread([run.numbers.get(key) for run in members])
    parameters = dict.fromkeys(k for run in members for k in run.numbers if k.startswith("parameters."))
    for key in parameters:
        estimates = [run.numbers[key] for run in members if key in run.numbers]
        entry[key] = _spread([_value(estimate) for estimate in estimates])
    return entry


def _value(estimate: Any) -> float:
    return float(estimate["value"]) if isinstance(estimate, Mapping) else float(estimate)


def _spread(values: Sequence[float | None]) -> dict[str, Any] | None:
    """Mean and standard deviation; None where no run has the number, no deviation of a single one."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return None
    deviation = float(np.std(known, ddof=1)) if len(known) > 1 else None
    return {"value": float(np.mean(known)), "deviation": deviation, "count": len(known)}


def _score(entry: Mapping[str, Any]) -> float:
    """What variants are ordered by: the held-out error where there is one, else the paper's loss."""
    for key in ("error_mrad.heldout", "loss.paper_eq7", "loss.fit"):
        if entry.get(key) is not None:
            return entry[key]["value"]
    return float("inf")


def _page(
    runs: Sequence[Run], keys: Sequence[str], variants: Mapping[str, Sequence[Run]], order: Sequence[Mapping[str, Any]]
) -> Page:
    best = order[0]
    lead = f"{len(runs)} runs of {len(variants)} {'variant' if len(variants) == 1 else 'variants'}."
    if len(variants) > 1:
        held = best["error_mrad.heldout"]
        by = "by the held-out error" if held is not None else "by the loss"
        lead = f"Best {by}: {best['variant']}. " + lead
    page = Page("Comparison of identifications", lead)
    page.section("Variants")
    header = ["variant", "runs"]
    for title in QUANTITIES.values():
        header += [title, "±"]
    rows: list[list[Cell]] = []
    for entry in order:
        row: list[Cell] = [entry["variant"], len(entry["runs"])]
        for key in QUANTITIES:
            row += _cells(entry[key])
        rows.append(row)
    page.table(header, rows, caption="Mean and standard deviation over seeds, best first.")
    page.figure(_figure(variants), "Every run: on the logs fitted and on those held out.")
    page.section("Parameters")
    names = list(dict.fromkeys(key for entry in order for key in entry if key.startswith("parameters.")))
    header = ["parameter", *(part for entry in order for part in (entry["variant"], "±"))]
    rows = [[words(key.removeprefix("parameters.")), *(c for e in order for c in _cells(e.get(key)))] for key in names]
    page.table(header, rows, caption="Values found, and how they differ between seeds.")
    page.section("Runs")
    header = ["run", *keys, *QUANTITIES.values()]
    rows = [
        [run.name, *(run.settings.get(key, "default") for key in keys), *(run.numbers.get(k) for k in QUANTITIES)]
        for run in runs
    ]
    page.table(header, rows, caption="Every run.")
    page.files({f"{run.name}/index.html": f"run {run.name}" for run in runs})
    page.files({NUMBERS: "all numbers of this page"})
    return page


def _cells(spread: Mapping[str, Any] | None) -> list[Cell]:
    return [None, None] if spread is None else [spread["value"], spread["deviation"]]


def _figure(variants: Mapping[str, Sequence[Run]]) -> go.Figure:
    """Fitted against held-out error of every run; without held-out logs, the paper's loss."""
    figure = go.Figure()
    colour = colours(list(variants))
    held = any(run.numbers.get("error_mrad.heldout") is not None for members in variants.values() for run in members)
    x, y = ("error_mrad.train", "error_mrad.heldout") if held else ("wall_seconds", "loss.paper_eq7")
    for name, members in variants.items():
        shown = [run for run in members if run.numbers.get(x) is not None and run.numbers.get(y) is not None]
        figure.add_scatter(
            x=[run.numbers[x] for run in shown], y=[run.numbers[y] for run in shown], mode="markers", name=plain(name),
            marker=dict(color=colour[name], size=10), hovertext=[f"run {run.name}" for run in shown],
            hovertemplate="%{hovertext}: %{x:.4g}, %{y:.4g}<extra></extra>",
        )  # fmt: skip
    dress(figure, 380, hovermode="closest")
    figure.update_xaxes(title_text="error on fitted logs [mrad]" if held else "time [s]")
    figure.update_yaxes(title_text="error on held-out logs [mrad]" if held else "paper eq. (7) [-]")
    return figure
