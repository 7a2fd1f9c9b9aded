"""The page of a plan of recordings."""

from collections.abc import Mapping, Sequence
from typing import Any

from op3.common.plain_names import words
from op3.identify.design import PlannedRecording, Step
from op3.identify.identifiability import SHARE
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import curves_figure


def report_design(
    steps: Sequence[Step],
    candidates: Sequence[PlannedRecording],
    wanted: Sequence[str],
    left_out: Mapping[str, str],
    run: RunFolder,
    wall_seconds: float,
) -> dict[str, Any]:
    """Publish a plan that was chosen from candidates; `left_out` states why motions could not be evaluated."""
    last, seconds = steps[-1], [step.seconds for step in steps]
    values = {
        "plan": [{"motion": step.name, "mount": step.mount, "seconds": step.seconds} for step in steps],
        "seconds": last.seconds,
        "interval_share": dict(last.widths),
        "wanted": list(wanted),
        "left_out": dict(left_out) or None,
        "wall_seconds": wall_seconds,
    }
    curves = {words(name): (seconds, [step.widths[name] for step in steps]) for name in wanted}
    width = "width of the 90 % interval [share of the range]"
    figure = curves_figure(curves, "robot time [s]", width, 420, "lines+markers", yaxis_type="log")
    places = [list(steps[0].widths).index(name) for name in wanted]
    tables = {
        "plan": (
            ["step", "motion", "mount", "cumulative robot time [s]"],
            [[i, words(s.name), s.mount, s.seconds] for i, s in enumerate(steps, start=1)],
        ),
        "candidates": (
            ["motion", "mount", "duration [s]", *map(words, wanted)],
            [[words(c.name), c.mount, c.duration, *(float(c.information[i, i]) ** 0.5 for i in places)]
             for c in candidates],
        ),
    }  # fmt: skip
    page = Page.of(
        "design", {"widths": figure}, tables, steps=steps, left_out=left_out, wanted=wanted, share=SHARE,
        clear=[name for name in wanted if last.widths[name] < SHARE],
        names=list(dict.fromkeys(step.name for step in steps)), worst=max(wanted, key=lambda name: last.widths[name]),
    )  # fmt: skip
    return publish(page, values, run)
