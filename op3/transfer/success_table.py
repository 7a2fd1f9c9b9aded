"""How often policies transfer, with intervals: the numbers of the paper's tables III and IV."""

from collections.abc import Mapping, Sequence
from typing import Any

from op3.common.sample_intervals import wilson_interval

Transferred = Mapping[str, Any]
"""Numbers of a run of sim2real, by dotted key."""


def last_transfer(cell: Transferred, name: str) -> Any:
    """A number of the last transfer of a run."""
    return cell[f"transfer_{cell['rounds']}.{name}"]


def _episodes(cells: Sequence[Transferred]) -> tuple[int, int]:
    """Episodes on the robot that went to their end, and all."""
    name = "walked" if cells[0]["task"] == "walk" else "upright"
    played = [last_transfer(cell, "episodes") for cell in cells]
    return sum(round(n * last_transfer(cell, name)) for n, cell in zip(played, cells, strict=True)), sum(played)


def transfer_rates(cells: Sequence[Transferred]) -> dict[str, Any]:
    """Transfers, successes with their 95 % interval, episodes to their end, and the mean share of the return."""
    good, (ended, episodes) = sum(bool(cell["success"]) for cell in cells), _episodes(cells)
    return {
        "transfers": len(cells),
        "successes": good,
        "at_once": sum(bool(cell["success"]) and not cell["rounds"] for cell in cells),
        "interval": list(wilson_interval(good, len(cells))),
        "episodes": episodes,
        "episodes_to_their_end": ended,
        "share": sum(last_transfer(cell, "share") for cell in cells) / len(cells),
    }
