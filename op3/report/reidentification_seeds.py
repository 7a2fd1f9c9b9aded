"""One page for the same re-identification over several seeds (paper, Fig. "Materials for analysis")."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.report.comparison import read_runs, varied
from op3.report.page import Page
from op3.report.reidentification import ACTUAL, BEFORE, FOUND
from op3.report.result import read_result, write_result
from op3.report.style import INK, PALETTE, dress, words
from op3.report.tables import Cell

PAGE, NUMBERS = "seeds.html", "seeds.yaml"
LABELS = {"excitation_only": BEFORE, "reidentified": FOUND}


def write_seeds(folder: str | Path) -> list[tuple[Path, Path]]:
    """Write page and numbers over the finished runs of a multirun that differ by their seed alone.

    Args:
        folder: of the multirun, with a run's folder for every seed.

    Returns:
        Their paths; where the runs differ in more than the seed, for every setting of the rest, by its first run.

    Raises:
        ValueError: if no run has finished.
    """
    folder = Path(folder)
    runs = read_runs(folder)
    others = [key for key in varied(runs) if key != "seed"]
    groups: dict[str, list[str]] = {}
    for run in runs:
        groups.setdefault(", ".join(f"{key}={run.settings.get(key)}" for key in others), []).append(run.name)
    return [_write(folder, names, said, "" if len(groups) == 1 else f"-{names[0]}") for said, names in groups.items()]


def _write(folder: Path, names: Sequence[str], said: str, mark: str) -> tuple[Path, Path]:
    runs = {name: read_result(folder / name / "result.yaml") for name in names}
    numbers = {"runs": len(runs)} | {
        key: _spread(runs, key) for key in ("distance.ratio", "fresh.ratio", "excitation.ratio")
    }
    parameters = _parameters(runs)
    for name in parameters:
        for key in LABELS:
            numbers[f"normalised.{key}.{name}"] = _spread(runs, f"normalised.{key}.{name}")
    meanings = {
        "normalised": "mean and standard deviation over seeds, as a share of the range of paper Table I",
        "distance": "Wasserstein-1 distance after re-identification as a share of that after excitation only",
        "fresh": "the same over episodes that the search has not seen",
        "excitation": "excitation loss after re-identification as a share of that before",
    }
    page_path, numbers_path = ((folder / name).with_stem(f"seeds{mark}") for name in (PAGE, NUMBERS))
    page = _page(runs, numbers, parameters, said, numbers_path.name)
    return page.write(page_path), write_result(numbers_path, numbers, meanings)


def _parameters(runs: Mapping[str, Mapping[str, Any]]) -> list[str]:
    prefix = "normalised.reidentified."
    return list(dict.fromkeys(k.removeprefix(prefix) for run in runs.values() for k in run if k.startswith(prefix)))


def _spread(runs: Mapping[str, Mapping[str, Any]], key: str) -> dict[str, Any] | None:
    """Mean and standard deviation over the runs that have the number; a single one has no deviation."""
    values = [run[key] for run in runs.values() if run.get(key) is not None]
    if not values:
        return None
    deviation = float(np.std(values, ddof=1)) if len(values) > 1 else None
    return {"value": float(np.mean(values)), "deviation": deviation, "count": len(values)}


def _page(
    runs: Mapping[str, Mapping[str, Any]],
    numbers: Mapping[str, Any],
    parameters: Sequence[str],
    said: str,
    numbers_name: str,
) -> Page:
    ratio = numbers["distance.ratio"]
    share = "unknown" if ratio is None else f"{ratio['value']:.2f}"
    page = Page(
        f"Re-identification over {len(runs)} seeds",
        f"Over {len(runs)} seeds the distance of returns falls to {share} of its value after excitation only."
        + (f" Settings: {said}." if said else ""),
    )
    page.section("Returns")
    page.figure(_returns(runs), "Returns of all runs: on the robot, after excitation only, and re-identified.")
    header = ["run", BEFORE, FOUND, f"{BEFORE}, fresh", f"{FOUND}, fresh", "chance", "excitation loss, times"]
    keys = (
        *(f"distance.{key}" for key in LABELS), *(f"fresh.{key}" for key in LABELS), "fresh.noise", "excitation.ratio",
    )  # fmt: skip
    rows: list[list[Cell]] = [[name, *(run.get(key) for key in keys)] for name, run in runs.items()]
    page.table(header, rows, "Wasserstein-1 distance to the robot's returns, by run.")
    page.section("Parameters")
    page.figure(_bars(numbers, parameters), "Parameters normalised by Table I: mean and standard deviation over seeds.")
    header = ["parameter", BEFORE, "±", FOUND, "±"]
    rows = [
        [words(name), *(c for k in LABELS for c in _cells(numbers[f"normalised.{k}.{name}"]))] for name in parameters
    ]
    page.table(header, rows, "As shares of the range of Table I.")
    page.files({f"{name}/index.html": f"run {name}" for name in runs} | {numbers_name: "all numbers of this page"})
    return page


def _cells(spread: Mapping[str, Any] | None) -> list[Cell]:
    return [None, None] if spread is None else [spread["value"], spread["deviation"]]


def _bars(numbers: Mapping[str, Any], parameters: Sequence[str]) -> go.Figure:
    figure = go.Figure()
    for (key, label), colour in zip(LABELS.items(), (PALETTE[1], PALETTE[0]), strict=True):
        spreads = [numbers[f"normalised.{key}.{name}"] for name in parameters]
        figure.add_bar(
            x=[words(name) for name in parameters],
            y=[spread["value"] for spread in spreads],
            error_y=dict(type="data", array=[spread["deviation"] or 0.0 for spread in spreads], thickness=1.2),
            name=label,
            marker_color=colour,
        )
    dress(figure, 440, barmode="group", margin=dict(l=70, r=80, t=48, b=120))
    figure.update_yaxes(title_text="share of the range [-]", range=[0, 1.05])
    return figure


def _returns(runs: Mapping[str, Mapping[str, Any]]) -> go.Figure:
    figure = go.Figure()
    keys = {"actual": (ACTUAL, INK), "excitation_only": (BEFORE, PALETTE[1]), "reidentified": (FOUND, PALETTE[0])}
    for key, (label, colour) in keys.items():
        x = [f"run {name}" for name, run in runs.items() for _ in run[f"returns.{key}"]]
        y = [value for run in runs.values() for value in run[f"returns.{key}"]]
        figure.add_box(x=x, y=y, name=label, boxpoints="all", jitter=0.5, pointpos=0, marker=dict(color=colour, size=4))
    dress(figure, 380, boxmode="group", hovermode="closest")
    figure.update_yaxes(title_text="return under R_eval [-]")
    return figure
