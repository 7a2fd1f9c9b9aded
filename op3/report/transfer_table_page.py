"""Success rates of transfers by training method: the paper's tables III and IV with intervals."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from op3.common.plain_names import words
from op3.report.page import Page
from op3.report.provenance import run_provenance
from op3.report.result import read_result, write_result
from op3.report.style import NAMES, boxes_figure
from op3.transfer.success_table import Transferred, last_transfer, transfer_rates

FAILED = "failed.txt"
"""File with the reason why a cell could not run."""

PAGE, NUMBERS = "transfers.html", "transfers.yaml"

PAPER = NAMES["paper"]

CONTROL = "retrained"
"""Control condition for comparison: a second training without new information."""


def read_cells(folder: str | Path) -> list[Transferred]:
    """All finished runs of sim2real directly in a folder, by name."""
    return [read_result(path) for path in sorted(Path(folder).glob("*/result.yaml"))]


def write_table(cells: Sequence[Transferred], folder: Path) -> tuple[Path, Path]:
    """Write page and numbers of at least one finished run, and list the cells of the folder that could not run."""
    values: dict[str, Any] = {}
    figures, tables = {}, {}
    for task in sorted({cell["task"] for cell in cells}):
        here = [cell for cell in cells if cell["task"] == task]
        found = {condition: [one for one in here if one["condition"] == condition] for condition in _conditions(here)}
        worlds = sorted({cell["world"] for cell in here})
        rates = {name: transfer_rates(of, found.get(CONTROL, ())) for name, of in found.items()}
        values[task] = rates
        paper = PAPER.get(task, {})
        tables[task] = (
            ["trained on", "paper", *worlds, "all", "95 % interval", "episodes to their end"],
            [[words(name), paper.get(name, ""), *_row(of, worlds, rates[name])] for name, of in found.items()],
        )
        tables[f"{task}_returns"] = (
            ["trained on", "share [%]", "promise error", f"share minus that of {words(CONTROL)} [%]"],
            [
                [
                    words(name),
                    100 * rate["share"],
                    _range(rate["promise_error"]),
                    _range(rate["share_over_control"], 100),
                ]
                for name, rate in rates.items()
            ],
        )
        shares = {
            w: {words(n): [last_transfer(c, "share") for c in of if c["world"] == w] for n, of in found.items()}
            for w in worlds
        }
        figures[task] = boxes_figure(shares, "return, robot over simulation [-]")
    columns = {"task": "task", "world": "robot", "condition": "trained on", "provenance.seed": "seed"}
    columns |= {"rounds": "learned from failures", "success": "success"}
    last = {"expected": "in simulation", "actual": "on the robot", "upright": "upright"}
    rows = [[*(cell[name] for name in columns), *(last_transfer(cell, k) for k in last)] for cell in cells]
    tables["cells"] = ([*columns.values(), *last.values()], rows)
    failed = {path.parent.name: path.read_text(encoding="utf-8").strip() for path in sorted(folder.glob(f"*/{FAILED}"))}
    tables["failed"] = (["cell", "reason why it could not run"], list(failed.items()))
    page, provenance = Page.of("transfers", figures, tables, cells=cells, tasks=list(values)), run_provenance()
    page.provenance(provenance)
    result = write_result(folder / NUMBERS, {**values, "failed": failed, "provenance": provenance})
    return page.write(folder / PAGE), result


def _conditions(cells: Sequence[Transferred]) -> list[str]:
    """The paper's conditions in its order, followed by all others."""
    there = list(dict.fromkeys(cell["condition"] for cell in cells))
    return [*(name for name in PAPER["balance"] if name in there), *(n for n in there if n not in PAPER["balance"])]


def _counts(cells: Sequence[Transferred]) -> str:
    good = [cell for cell in cells if cell["success"]]
    return f"{len(good)}/{len(cells)} ({sum(not cell['rounds'] for cell in good)})" if cells else "–"


def _row(cells: Sequence[Transferred], worlds: Sequence[str], rates: Mapping[str, Any]) -> list[Any]:
    low, high = rates["interval"]
    return [
        *(_counts([cell for cell in cells if cell["world"] == world]) for world in worlds),
        _counts(cells),
        f"{100 * low:.0f} to {100 * high:.0f} %",
        f"{rates['episodes_to_their_end']} of {rates['episodes']}",
    ]


def _range(values: Sequence[float] | None, factor: float = 1.0) -> str:
    """A mean with its interval; a single robot has no interval."""
    if values is None:
        return "–"
    mean, *ends = (f"{factor * value:.3g}" for value in values)
    return f"{mean} ({' to '.join(ends)})" if ends else mean
