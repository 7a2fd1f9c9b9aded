"""The page and numbers of a policy's evaluation."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import PALETTE, band, boxes_figure, dress, shade, words
from op3.report.traces import body_figure, traces_figure
from op3.robot import load_robot
from op3.rollout import Rollout
from op3.tasks.behaviour import GaitProfile


def gait_figure(profile: GaitProfile, joint: str) -> go.Figure:
    """Target angle and P gain over the gait, mean and standard deviation, with the stance of the foot shaded."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.08)
    rows = (
        (np.rad2deg(profile.target), np.rad2deg(profile.target_deviation), "target angle [deg]"),
        (profile.gain, profile.gain_deviation, "P gain [A/rad]"),
    )
    for row, (mean, deviation, axis) in enumerate(rows, start=1):
        colour, place = PALETTE[row - 1], dict[str, Any](row=row, col=1)
        band(figure, profile.phase, mean - deviation, mean + deviation, colour, **place)
        figure.add_scatter(
            x=profile.phase, y=mean, mode="lines", line=dict(color=colour, width=2.2), name=axis, **place
        )
        figure.update_yaxes(title_text=axis, **place)
    shade(figure, profile.phase[profile.stance], len(profile.phase))
    figure.update_xaxes(
        title_text=f"phase of the gait [cycles]; shaded: stance of the {words(joint[:2]).strip()} foot", row=2
    )
    figure.update_xaxes(range=[0, 1])
    return dress(figure, 420, showlegend=False)


def report_evaluation(
    logs: Sequence[Rollout],
    run: RunFolder,
    *,
    label: str,
    task: str,
    numbers: Mapping[str, Any],
    returns: Mapping[str, Sequence[float]],
    profile: GaitProfile | None = None,
    joint: str | None = None,
    files: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Write ``index.html`` and ``result.yaml`` and print the paths of both.

    Args:
        logs: the episodes; the first and the worst are drawn.
        run: where it is kept.
        label: of the policy.
        task: that was attempted.
        numbers: for ``result.yaml``.
        returns: R_eval of every episode by label, the policy's first and any baselines' after it.
        profile: of the gait, for walking.
        joint: that the profile is of; None: an ankle.
        files: that lie beside the page, with what is in them.

    Returns:
        The numbers of ``result.yaml``.
    """
    upright, mean = numbers["evaluation.upright"], numbers["evaluation.return_mean"]
    page = Page(
        f"Evaluation: {label} at {task}",
        f"The policy ends {round(upright * len(logs))} of {len(logs)} episodes upright. Its mean return under R_eval "
        f"is {mean:.1f} (standard deviation {numbers['evaluation.return_std']:.1f}).",
    )
    page.tile("upright", round(upright * len(logs)), "", f"of {len(logs)} episodes")
    if "evaluation.success_interval" in numbers:
        low, high = numbers["evaluation.success_interval"]
        page.tile("success", numbers["evaluation.success"], "", f"share of episodes; 95 %: {low:.2f} to {high:.2f}")
    page.tile("R_eval", mean, "", "mean per episode")
    if "evaluation.margin" in numbers:
        low, high = numbers.get("evaluation.margin_interval", (float("nan"),) * 2)
        note = f"more R_eval than {numbers['evaluation.baseline']} on the same episodes; 95 %: {low:.1f} to {high:.1f}"
        page.tile("margin", numbers["evaluation.margin"], "", note)
    if "evaluation.gain" in numbers:
        page.tile("P gain", numbers["evaluation.gain"], "A/rad", "mean of the controlled joints")
    if "evaluation.speed" in numbers:
        page.tile("speed", numbers["evaluation.speed"], "m/s", "mean forward speed of the foremost foot")
    page.tile("tilt", float(np.rad2deg(numbers["evaluation.tilt"])), "deg", "mean of the trunk from upright")
    page.section("Returns")
    boxes = {label: {label: values} for label, values in returns.items()}
    page.figure(boxes_figure(boxes, "R_eval per episode [-]"), "R_eval of every episode; the box spans the quartiles.")
    if profile is not None:
        page.section("Gait")
        joint = load_robot().legs[1][-2] if joint is None else joint
        caption = f"The {words(joint)} over the gait: mean and standard deviation over all cycles and episodes."
        page.figure(gait_figure(profile, joint), caption)
    page.section("One episode")
    page.figure(body_figure(logs[0], {}), "The trunk in the first episode.")
    joints = [leg[place] for place in (-2, -1) for leg in load_robot().legs]
    quantities = [key for key in ("joint/position", "command/p_gain", "joint/current") if key in logs[0]]
    page.figure(traces_figure(logs[0], {}, joints, quantities), "The ankles in the first episode.")
    page.side_files(files)
    meanings = {"evaluation": "means over episodes unless listed; gain [A/rad], tilt [rad], duration [s]"}
    return publish(page, numbers, run, meanings)
