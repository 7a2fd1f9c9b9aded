"""One page for the same re-identification over several seeds (paper, Fig. "Materials for analysis")."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from op3.report.comparison_page import Run, read_runs, spread, spread_cells, variants
from op3.report.page import Page
from op3.report.reidentification_page import ACTUAL, BEFORE, FOUND
from op3.report.result import write_result
from op3.report.style import bars_figure, boxes_figure, words

PAGE, NUMBERS = "seeds.html", "seeds.yaml"
LABELS = {"reidentified": FOUND, "excitation_only": BEFORE}

MEANINGS: Mapping[str, str] = {
    "normalised": "mean and standard deviation over seeds, as a share of the range of paper Table I",
    "distance": "Wasserstein-1 distance after re-identification as a share of that after excitation only",
    "fresh": "the same over episodes that the search has not seen",
    "excitation": "excitation loss after re-identification as a share of that before",
}


def write_seeds(folder: str | Path) -> list[tuple[Path, Path]]:
    """Write page and numbers over the finished runs of a multirun that differ by their seed alone.

    Args:
        folder: of the multirun, with a run's folder for every seed.

    Returns:
        Their paths; where the runs differ in more than the seed, for every setting of the rest, by its first run.

    Raises:
        ValueError: if no run has finished.
    """
    groups = variants(read_runs(folder))
    return [
        _write(Path(folder), runs, "" if len(groups) == 1 else said, "" if len(groups) == 1 else f"-{runs[0].name}")
        for said, runs in groups.items()
    ]


def _write(folder: Path, runs: Sequence[Run], said: str, mark: str) -> tuple[Path, Path]:
    keys = ["distance.ratio", "fresh.ratio", "excitation.ratio"]
    keys += list(dict.fromkeys(key for run in runs for key in run.numbers if key.startswith("normalised.")))
    numbers = {key: spread([run.numbers.get(key) for run in runs]) for key in keys}
    page_path, numbers_path = ((folder / name).with_stem(f"seeds{mark}") for name in (PAGE, NUMBERS))
    page = _page(runs, numbers, said, numbers_path.name)
    return page.write(page_path), write_result(numbers_path, {"runs": len(runs), **numbers}, MEANINGS)


def _page(runs: Sequence[Run], numbers: Mapping[str, Any], said: str, numbers_name: str) -> Page:
    ratio = numbers["distance.ratio"]
    share = "unknown" if ratio is None else f"{ratio['value']:.2f}"
    page = Page(
        f"Re-identification over {len(runs)} seeds",
        f"Over {len(runs)} seeds the distance of returns falls to {share} of its value after excitation only."
        + (f" Settings: {said}." if said else ""),
    )
    page.section("Returns")
    boxes = {
        label: {f"run {run.name}": run.numbers[f"returns.{key}"] for run in runs}
        for key, label in {**LABELS, "actual": ACTUAL}.items()
    }
    caption = "Returns of all runs: on the robot, after excitation only, and re-identified."
    page.figure(boxes_figure(boxes, "return under R_eval [-]"), caption)
    header = ["run", *LABELS.values(), *(f"{label}, fresh" for label in LABELS.values()), "chance", "excitation, times"]
    keys = [*(f"{what}.{key}" for what in ("distance", "fresh") for key in LABELS), "fresh.noise", "excitation.ratio"]
    rows = [[run.name, *(run.numbers.get(key) for key in keys)] for run in runs]
    page.table(header, rows, "Wasserstein-1 distance to the robot's returns, by run.")
    page.section("Parameters")
    start = "normalised.reidentified."
    names = [key.removeprefix(start) for key in numbers if key.startswith(start)]
    found = {label: {name: numbers[f"normalised.{key}.{name}"] for name in names} for key, label in LABELS.items()}
    bars = {label: {name: one["value"] for name, one in by.items()} for label, by in found.items()}
    errors = {label: {name: one["deviation"] or 0.0 for name, one in by.items()} for label, by in found.items()}
    page.figure(
        bars_figure(bars, "share of the range [-]", errors),
        "Parameters normalised by Table I: mean and standard deviation over seeds.",
    )
    header = ["parameter", *(part for label in LABELS.values() for part in (label, "±"))]
    rows = [[words(name), *(cell for by in found.values() for cell in spread_cells(by[name]))] for name in names]
    page.table(header, rows, "As shares of the range of Table I.")
    page.files(
        {f"{run.name}/index.html": f"run {run.name}" for run in runs} | {numbers_name: "all numbers of this page"}
    )
    return page
