"""Figures: units on axes, one trace per label, missing channels, honest marks."""

import re
from itertools import pairwise

import numpy as np
import plotly.graph_objects as go
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from report_logs import bench_log, squat_log

from op3.replay import Prediction
from op3.report.figures import history_figure, ranges_figure
from op3.report.panels import thin
from op3.report.trace_figures import bench_figures, body_figure, runs_figure, traces_figure
from op3.servo import Estimate, RobotModel
from op3.servo.effects import DirectionalEfficiency, Motor


def prediction(log, channels, seconds=0.48) -> Prediction:
    """A prediction of one candidate from arrays ``[time, joint | 3]``."""
    one = {key: torch.as_tensor(value[None]) for key, value in channels.items()}
    return Prediction(log, one, torch.zeros(1, dtype=torch.bool), seconds)


def simulated(log, factor):
    return prediction(log, {key: factor * log.array(key) for key in log.channels if key[0] in ("joint", "imu")})


def y_titles(figure: go.Figure) -> list[str]:
    return [axis.title.text for axis in figure.select_yaxes() if axis.title.text]


def named(figure: go.Figure, label: str) -> list:
    """Traces with data of this label."""
    return [trace for trace in figure.data if trace.legendgroup == label and trace.y[0] is not None]


def models() -> dict[str, RobotModel]:
    with_dte = RobotModel((Motor(), DirectionalEfficiency()), {"backward_efficiency": Estimate(0.7, 0.65, 0.75)})
    return {"with DTE": with_dte, "without DTE": RobotModel((Motor(),))}


def every_figure() -> list[go.Figure | None]:
    log = squat_log()
    bench = [bench_log("sin_sin", 0.2, 8.0), bench_log("lift_and_drop", 0.2, 16.0)]
    both = {"with DTE": simulated(log, 1.1), "without DTE": simulated(log, 0.8)}
    return [
        traces_figure(log, both),
        body_figure(log, both),
        runs_figure(bench, {"M1": [simulated(run, 1.1) for run in bench]}),
        history_figure({"with DTE": [2.0, 1.0]}, {"with DTE": [1.0, 0.9]}),
        ranges_figure(models(), ["backward_efficiency"]),
    ]


@pytest.mark.parametrize("number", range(5))
def test_axes_have_titles_with_units(number):
    """Every axis title of every figure, and every tick that names a parameter, carries a unit."""
    figure = every_figure()[number]
    assert figure is not None
    titles = [a.title.text for a in (*figure.select_xaxes(), *figure.select_yaxes()) if a.title.text]
    titles += [text for axis in figure.select_yaxes() for text in axis.ticktext or () if re.search("[a-z]", text)]
    assert len(titles) >= 2
    assert all(re.search(r"\[[^]]+\]", title) for title in titles), titles


def test_each_panel_has_one_trace_per_label():
    """Two joints by three quantities give six panels with measured, and each prediction, once each."""
    log = squat_log()
    figure = traces_figure(log, {"with DTE": simulated(log, 1.1), "without DTE": simulated(log, 0.8)})
    for label in ("measured", "with DTE", "without DTE"):
        assert len({trace.yaxis for trace in named(figure, label)}) == len(named(figure, label)) == 6
    assert [t.name for t in figure.data if t.showlegend is not False] == [
        "measured",
        "with DTE",
        "without DTE",
        "command",
    ]


def test_traces_are_the_numbers_in_degrees():
    """The measured knee angle is drawn in degrees, the simulated one likewise."""
    log = squat_log()
    figure = traces_figure(
        log, {"with DTE": simulated(log, 1.5)}, joints=["r_knee"], quantities=[("joint", "position")]
    )
    knee = np.rad2deg(log.column("r_knee.position"))
    np.testing.assert_allclose(named(figure, "measured")[0].y, knee, rtol=1e-6)
    np.testing.assert_allclose(named(figure, "with DTE")[0].y, 1.5 * knee, rtol=1e-6)


def test_right_joints_follow_their_left_partners():
    """Rows run left knee, right knee, left ankle, right ankle whatever the log's order."""
    log = squat_log(joints=("l_knee", "l_ank_pitch", "r_knee", "r_ank_pitch"))
    rows = [annotation.text for annotation in traces_figure(log, {}).layout.annotations]
    sides = ["left knee", "right knee", "left ankle pitch", "right ankle pitch"]
    assert rows == [f"<b>{name}</b>" for name in sides]


def test_a_missing_channel_has_no_column_and_no_trace():
    """Without measured current there is no current column; a prediction without it leaves the measured one alone."""
    log, whole = squat_log(leave_out=("joint/current",)), squat_log()
    figure = traces_figure(log, {"with DTE": simulated(whole, 1.0)})
    assert set(y_titles(figure)) == {"position [deg]", "velocity [rad/s]"}
    angles = prediction(whole, {("joint", "position"): whole.array("joint/position")})
    figure = traces_figure(whole, {"with DTE": angles})
    assert (len(named(figure, "with DTE")), len(named(figure, "measured"))) == (2, 6)


def test_a_log_without_body_has_no_body_figure():
    """A bench log gives None, and one with roll and pitch alone gives those two."""
    assert body_figure(bench_log("sin_sin", 0.2, 8.0), {}) is None
    only = body_figure(squat_log(leave_out=("imu/angular_velocity",)), {})
    assert only is not None
    assert y_titles(only) == ["roll [deg]", "pitch [deg]"]


def test_a_prediction_that_ends_early_is_drawn_up_to_its_end():
    """Thirty of sixty rows."""
    log = squat_log(rows=60)
    half = prediction(log, {key: value[0, :30].numpy() for key, value in simulated(log, 1.1).channels.items()})
    assert {len(t.y) for t in named(traces_figure(log, {"with DTE": half}), "with DTE")} == {30}


def test_body_angles_do_not_jump_by_a_turn():
    """A roll that passes 180 degrees is drawn on, not folded back."""
    log = squat_log()
    roll = np.linspace(3.0, 3.4, len(log))
    folded = np.stack([np.where(roll > np.pi, roll - 2 * np.pi, roll)] * 3, axis=1)
    figure = body_figure(log, {"with DTE": prediction(log, {("imu", "orientation"): folded})})
    assert figure is not None
    np.testing.assert_allclose(named(figure, "with DTE")[0].y, np.rad2deg(roll), rtol=1e-5)


@given(st.integers(0, 2**32 - 1), st.integers(10, 5000), st.sampled_from([20, 100, 1000]))
def test_thinning_keeps_extremes_ends_and_order(seed, rows, most):
    """A thinned trace is a subset in order, with both ends and the global extremes."""
    values = np.random.default_rng(seed).normal(size=rows)
    time, kept = thin(np.arange(rows, dtype=float), values, most)
    assert len(kept) <= most + 2
    assert (values[time.astype(int)] == kept).all()
    assert all(a < b for a, b in pairwise(time))
    assert (time[0], time[-1]) == (0, rows - 1)
    assert (kept.min(), kept.max()) == (values.min(), values.max())


def test_best_so_far_never_rises_and_skips_failures():
    """Failed trials, None or NaN, leave the best where it was."""
    figure = history_figure({"with DTE": [3.0, None, 4.0, float("nan"), 1.0, 2.0]})
    (best,) = figure.data
    assert list(best.y) == [3.0, 3.0, 3.0, 3.0, 1.0, 1.0]
    assert figure.layout.yaxis.type == "log"


def test_ranges_place_values_intervals_and_nominals():
    """0.7 in [0.6, 1.0] lies at a quarter, with its interval, start and text; the other model has no marker."""
    start, shown, _, other, _ = ranges_figure(models(), ["backward_efficiency"]).data
    assert [*start.x, *shown.x, *other.x] == pytest.approx([0.5, 0.25])
    assert [*shown.error_x.arrayminus, *shown.error_x.array] == pytest.approx([0.125, 0.125])
    assert shown.text[0].startswith("0.70 (0.65 to 0.75)")


def test_bench_errors_are_boxes_by_motion_and_held_out_runs_apart():
    """Runs of one trajectory share a place, those held out have their own label, and a failed one has no error."""
    logs = [bench_log("sin_sin", 0.4, 8.0), bench_log("sin_sin", 0.2, 16.0), bench_log("lift_and_drop", 0.2, 8.0)]
    empty = [prediction(log, {}) for log in logs]
    figure = bench_figures(logs, {"M1": empty}, {"M1": [30.0, 20.0, None]}, [True, False, False])["errors"]
    boxes = {box.name: dict(zip(box.x, box.y, strict=True)) for box in figure.data}
    assert boxes == {"M1, held out": {"sin sin": 30.0}, "M1": {"sin sin": 20.0}}
