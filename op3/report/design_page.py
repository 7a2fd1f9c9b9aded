"""The page of a plan of recordings."""

from collections.abc import Mapping, Sequence
from typing import Any

from op3.identify.design import Candidate, Step
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import curves_figure, words
from op3.report.tables import number

MEANINGS: Mapping[str, str] = {
    "plan": "recordings in the order to make them",
    "seconds": "robot time of the whole plan [s]",
    "interval_share": "expected width of each 90 % interval after the plan, as a share of the range",
    "left_out": "motions that the model cannot play, and why",
}


def report_design(
    steps: Sequence[Step],
    candidates: Sequence[Candidate],
    wanted: Sequence[str],
    left_out: Mapping[str, str],
    run: RunFolder,
    wall_seconds: float,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml``, and print their paths.

    Args:
        steps: the plan.
        candidates: what it was chosen from.
        wanted: parameters whose intervals counted.
        left_out: motions that could not be judged, with the reason.
        run: where it is kept.
        wall_seconds: duration of the run [s].
    """
    values = {
        "plan": [{"motion": step.name, "mount": step.mount, "seconds": step.seconds} for step in steps],
        "seconds": steps[-1].seconds,
        "interval_share": dict(steps[-1].widths),
        "wanted": list(wanted),
        "left_out": dict(left_out) or None,
        "wall_seconds": wall_seconds,
    }
    return publish(_page(steps, candidates, wanted, left_out), values, run, MEANINGS)


def _page(
    steps: Sequence[Step], candidates: Sequence[Candidate], wanted: Sequence[str], left_out: Mapping[str, str]
) -> Page:
    names = list(dict.fromkeys(step.name for step in steps))
    worst = max(wanted, key=lambda name: steps[-1].widths[name])
    share = number(100 * steps[-1].widths[worst], 2)
    lead = f"Record {', '.join(words(name) for name in names)}: {number(steps[-1].seconds, 3)} s of robot time."
    lead += f" The widest interval of the wanted parameters, {words(worst)}, is then {share} % of its range."
    page = Page("Plan of recordings", lead)
    page.section("Plan")
    rows = [[i, words(s.name), s.mount, s.seconds] for i, s in enumerate(steps, start=1)]
    page.table(["step", "motion", "mount", "robot time up to here [s]"], rows)
    page.code("python experiments/collect.py plan=<this folder>/plan.yaml robot=...")
    page.section("What it gives")
    seconds = [step.seconds for step in steps]
    widths = {words(name): (seconds, [step.widths[name] for step in steps]) for name in wanted}
    figure = curves_figure(widths, "robot time [s]", "width of the 90 % interval [share of the range]", 420,
                           mode="lines+markers", yaxis_type="log")  # fmt: skip
    page.figure(figure, "Expected 90 % intervals after each recording, as a share of the ranges.")
    page.section("What there was to choose from")
    places = [list(steps[0].widths).index(name) for name in wanted]
    rows = [
        [words(c.name), c.mount, c.duration, *(float(c.information[i, i]) ** 0.5 for i in places)] for c in candidates
    ]
    header = ["motion", "mount", "duration [s]", *(words(name) for name in wanted)]
    caption = "Sensitivity to each parameter alone: inverse of the standard deviation in ranges."
    page.table(header, rows, caption=caption, digits=3)
    for name, reason in left_out.items():
        page.text(f"Left out: {words(name)}. {reason}")
    page.section("Files")
    page.files({"plan.yaml": "the plan that collect plays", "result.yaml": "all numbers of this page"})
    return page
