"""The page of a hidden-effect bench, from plain scores."""

import numpy as np
from report_logs import PageReader

from experiments.hidden_bench.naming_page import LABELS, naming_page, rates_figure, reliability_figure


def rate(count: int, of: int) -> dict[str, float]:
    return {"value": count / of, "low": 0.1, "high": 0.9, "count": count, "of": of}


def summary(exact: int) -> dict:
    table = [[0.9, 0.8, 0.5, 0.95, 10]] if exact else []
    calibration = {"ece": 0.1 if exact else None, "reliability": table, "findings": 10 if exact else 0}
    rates = {"clear_exact": rate(exact, 4), "sound_named": rate(1, 2), "pairs_both": None}
    return {"cases": 6, "failed": 0, "calibration": calibration, **rates}


ROW = {
    "case": "case_1", "kind": "single", "robot": "op3", "severity": "strong", "truth": "backlash",
    "truth_joints": "r_knee", "claim": "dte", "claim_joints": "", "probability": 0.5, "size_ratio": None,
    "seconds": 50.0,
}  # fmt: skip


def test_the_page_says_the_counts_first():
    """The verdict sentence has both counts; every case is in the table; the page is well-formed."""
    page = naming_page([ROW], {"diagnosis": summary(3), "random name": summary(0)}, "Bench", "0f" * 32)
    html = page.html()
    assert PageReader(html).open == []
    assert (
        "3 of 4 clear single effects were named in their joints, and an effect was named in 1 of 2 sound robots."
        in html
    )
    assert "case_1" in html
    assert "0f" * 32 in html


def test_rates_are_drawn_with_their_intervals():
    """A rate of 75 % in [10, 90] % has bars of 15 and 65; a rate that was not asked for has no row."""
    figure = rates_figure({"diagnosis": summary(3)})
    (points,) = figure.data
    assert list(figure.layout.yaxis.ticktext) == [LABELS["clear_exact"][0], LABELS["sound_named"][0]]
    assert points.x[0] == 75
    assert np.allclose(points.error_x.array[0], 15)
    assert np.allclose(points.error_x.arrayminus[0], 65)


def test_nothing_stated_draws_no_reliability():
    """Without findings there is no curve."""
    assert reliability_figure({"diagnosis": summary(0)["calibration"]}) is None
    assert reliability_figure({"diagnosis": summary(3)["calibration"]}) is not None
