"""Success rates of transfers with intervals: the numbers of the paper's tables III and IV."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from op3.common.sample_intervals import mean_interval, wilson_interval

Transferred = Mapping[str, Any]
"""Numbers of a run of sim2real, by dotted key."""


def last_transfer(cell: Transferred, name: str) -> Any:
    """A number of the last transfer of a run."""
    return cell[f"transfer_{cell['rounds']}.{name}"]


def _episodes(cells: Sequence[Transferred]) -> tuple[int, int]:
    """Number of episodes on the robot that reached their end, and of all episodes."""
    name = "walked" if cells[0]["task"] == "walk" else "upright"
    played = [last_transfer(cell, "episodes") for cell in cells]
    return sum(round(n * last_transfer(cell, name)) for n, cell in zip(played, cells, strict=True)), sum(played)


def transfer_rates(cells: Sequence[Transferred], control: Sequence[Transferred] = ()) -> dict[str, Any]:
    """Success rate of a condition, and differences between actual and expected returns, with 95 % intervals.

    Results of one robot are correlated, so intervals are computed over robots, each with the mean of its cells.

    Args:
        cells: finished cells of one task and condition.
        control: cells of the condition for comparison, robot by robot; empty: no comparison.
    """
    good, (ended, episodes) = sum(bool(cell["success"]) for cell in cells), _episodes(cells)
    robots = _by_robot(cells, lambda cell: float(cell["success"]))
    shares, others = (_by_robot(of, lambda cell: last_transfer(cell, "share")) for of in (cells, control))
    short = _by_robot(cells, lambda cell: last_transfer(cell, "expected") - last_transfer(cell, "actual"))
    return {
        "transfers": len(cells),
        "successes": good,
        "at_once": sum(bool(cell["success"]) and not cell["rounds"] for cell in cells),
        "robots": len(robots),
        "interval": list(wilson_interval(sum(robots.values()), len(robots))),
        "episodes": episodes,
        "episodes_to_their_end": ended,
        "share": sum(last_transfer(cell, "share") for cell in cells) / len(cells),
        "promise_error": _mean(short.values()),
        "share_over_control": _mean(shares[name] - others[name] for name in shares.keys() & others),
    }


def _by_robot(cells: Sequence[Transferred], number: Callable[[Transferred], float]) -> dict[str, float]:
    """Mean of a number over the cells of each robot."""
    by_robot: dict[str, list[float]] = {}
    for cell in cells:
        by_robot.setdefault(cell["world"], []).append(number(cell))
    return {name: sum(values) / len(values) for name, values in sorted(by_robot.items())}


def _mean(values: Iterable[float]) -> list[float] | None:
    """Mean, low and high; for one robot only its value, and None without robots."""
    numbers = list(values)
    if len(numbers) < 2:
        return numbers or None
    return [sum(numbers) / len(numbers), *mean_interval(numbers)]
