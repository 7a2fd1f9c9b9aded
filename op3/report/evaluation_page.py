"""The page and numbers of a policy's evaluation."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from op3.common.plain_names import words
from op3.report.page import Page
from op3.report.result import RunFolder, publish
from op3.report.style import boxes_figure, grid_figure, shade
from op3.report.trace_figures import body_figure, traces_figure
from op3.rollout import Rollout
from op3.tasks.behaviour import GaitProfile

QUANTITIES = (("joint", "position"), ("command", "p_gain"), ("joint", "current"))
"""Channels of the ankles that are drawn if the log has them."""


def gait_figure(profile: GaitProfile, joint: str) -> go.Figure:
    """Target angle and P gain over the gait, mean and standard deviation, with the stance of the foot shaded."""
    panels = {
        axis: {axis: (profile.phase, mean, mean - deviation, mean + deviation)}
        for axis, mean, deviation in (
            ("target angle [deg]", np.rad2deg(profile.target), np.rad2deg(profile.target_deviation)),
            ("P gain [A/rad]", profile.gain, profile.gain_deviation),
        )
    }
    title = f"phase of the gait [cycles]; shaded: stance of the {words(joint[:2]).strip()} foot"
    figure = grid_figure(panels, title, 420, showlegend=False)
    shade(figure, profile.phase[profile.stance], len(profile.phase))
    return figure.update_xaxes(range=[0, 1])


def report_evaluation(
    logs: Sequence[Rollout],
    run: RunFolder,
    *,
    label: str,
    task: str,
    numbers: Mapping[str, Any],
    returns: Mapping[str, Sequence[float]],
    profile: GaitProfile | None,
    joint: str,
    files: Mapping[str, str],
) -> dict[str, Any]:
    """Publish an evaluation; the first log is drawn.

    `returns` has R_eval of every episode by label, beginning with the policy's. `profile` is the joint's gait profile,
    for a walking policy.
    """
    robot = logs[0].robot
    outer = [leg[place] for place in (-2, -1) for leg in robot.legs] or list(robot.arm[-2:])
    figures = {
        "returns": boxes_figure({name: {name: values} for name, values in returns.items()}, "R_eval per episode [-]"),
        "gait": None if profile is None else gait_figure(profile, joint),
        "body": body_figure(logs[0], {}),
        "ankles": traces_figure(logs[0], {}, outer, QUANTITIES),
    }
    page = Page.of(
        "evaluation", figures, n=numbers, episodes=len(logs), label=label, task=task, joint=joint, files=files
    )
    return publish(page, numbers, run)
