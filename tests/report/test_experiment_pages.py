"""Pages of experiments from results made by hand: what stands where, and what is said of it."""

import numpy as np
import pytest
import torch
from report_logs import PageReader, bench_log, squat_log

from op3.identify.design import PlannedRecording, Step
from op3.identify.identifiability import Identifiability
from op3.identify.identification import Fit, FitScore
from op3.replay import Prediction
from op3.report import RunFolder, read_result
from op3.report.design_page import report_design
from op3.report.evaluation_page import report_evaluation
from op3.report.identification_page import report_identification
from op3.report.training_page import report_training
from op3.robot import load_robot
from op3.sim import load_model
from op3.tasks.behaviour import GaitProfile

NAMES = ("torque_constant", "backward_efficiency")


def read(folder) -> str:
    reader = PageReader((folder / "index.html").read_text())
    assert reader.open == []
    return reader.text


def score(logs, factor: float) -> FitScore:
    """Predictions that are the measurements times a factor."""
    predictions = [
        Prediction(
            log,
            {k: torch.as_tensor(factor * log.array(k)[None]) for k in log.channels if k[0] in ("joint", "imu")},
            torch.zeros(1, dtype=torch.bool),
            0.3,
        )
        for log in logs
    ]
    terms = {"joint/position": 0.2 * factor}
    return FitScore(0.3 * factor, 0.4 * factor, terms, 11 * factor, [11 * factor] * len(logs), predictions)


def fit(label: str, logs, heldout, factor: float) -> Fit:
    known = Identifiability(
        NAMES, {"joint/position": 1e-3}, np.array([50.0, 2.0]), np.eye(2), np.eye(2), dict.fromkeys(NAMES, 0.1),
        [NAMES[1]], dict(zip(NAMES, (True, False), strict=True)), ["nobody knows the sum"],
    )  # fmt: skip
    bounds = {"torque_constant": (0.003, 0.009), "backward_efficiency": (0.6, 1.0)}
    model, starts = load_model("paper").with_values({NAMES[1]: 1.0}), {"torque_constant": 0.006}
    held = score(heldout, 1.5 * factor)
    return Fit(
        label, model, NAMES, score(logs, factor), held, bounds, starts, [3.0, float("nan"), 1.0], [1, 0.9], known
    )


@pytest.mark.parametrize("bench", [False, True])
def test_an_identification_is_compared_told_and_marked(tmp_path, bench):
    """Both models on both sets of logs, errors on a bench and losses on a robot; what is at a bound comes first."""
    logs = [bench_log("sin_sin", 0.2, 8.0), bench_log("lift_and_drop", 0.2, 16.0)] if bench else [squat_log()] * 2
    fits = fit("with DTE", logs[:1], logs[1:], 1.0), fit("without DTE", logs[:1], logs[1:], 2.0)
    report_identification(*fits, RunFolder(tmp_path, {}), wall_seconds=2.0)
    what = ("mean position error is 11 mrad", "22 mrad") if bench else ("loss is 0.3", "0.6")
    text = read(tmp_path)
    assert f"With DTE the {what[0]}, without DTE {what[1]}; on held-out logs " in text
    assert "At the bound of the searched range: backward efficiency." in text
    assert "Nobody knows the sum." in text
    assert ("Error of every run" in text) == bench
    assert ("Held out: " in text) != bench
    numbers = read_result(tmp_path / "result.yaml")
    found = numbers["loss.heldout"], numbers["loss.fit_without_dte"], numbers["trials_failed"]
    assert found == pytest.approx((0.45, 0.6, 1))


def test_a_training_ends_with_its_best_policy(tmp_path):
    """The verdict is that of the final episodes; the learning curve is among the numbers."""
    history = [
        {"steps": 1000 * i, "evaluation/return": 10.0 * i, "evaluation/upright": 0.5, "reward": i, "reward_terms/a": i}
        for i in range(1, 4)
    ]
    numbers = {"evaluation.upright": 0.75, "evaluation.return": 29.0, "policy.steps": 3000, "steps": 3000,
               "updates": 40, "evaluation.episodes": 4, "wall_seconds": 90.0}  # fmt: skip
    shown = {"settings": {"algorithm.n_step": 5}, "files": {"episode.mp4": "a film"}}
    report_training(history, RunFolder(tmp_path, {}), title="Training: balance", numbers=numbers, **shown)
    text = read(tmp_path)
    assert "stays upright in 75 % of the final episodes, with a mean return of 29.0." in text
    assert "1.5 min" in text.replace("  ", " ")
    assert read_result(tmp_path / "result.yaml")["learning.return"] == [10.0, 20.0, 30.0]


@pytest.mark.parametrize("walks", [True, False])
def test_an_evaluation_shows_the_gait_of_who_walks(tmp_path, walks):
    """Success, margin and speed where they are known; the gait's figure for walking."""
    log = squat_log(joints=tuple(leg[place] for leg in load_robot("op3").legs for place in (-2, -1)))
    numbers = {"evaluation.upright": 0.5, "evaluation.success": 0.5, "evaluation.return_mean": 200.0}
    numbers |= {"evaluation.return_std": 3.0, "evaluation.tilt": np.pi / 180}
    if walks:
        numbers |= {"evaluation.success_interval": [0.3, 1.0], "evaluation.margin": 20.0,
                    "evaluation.baseline": "hold", "evaluation.speed": 0.25}  # fmt: skip
    phase = (np.arange(10) + 0.5) / 10
    profile = GaitProfile(phase, phase, phase, phase, phase, phase > 0.5) if walks else None
    said = {"label": "walk", "task": "walk", "returns": {"walk": [197.0, 203.0]}, "joint": "r_ank_pitch", "files": {}}
    report_evaluation([log, log], RunFolder(tmp_path, {}), numbers=numbers, profile=profile, **said)
    text = read(tmp_path)
    assert "1 of 2 episodes succeed, 1 end without failing" in text
    assert "R_eval 200.0 (standard deviation 3.0)." in text
    assert all((part in text) == walks for part in ("95 %: 30 to 100", "R_eval above hold", "over the gait"))


def test_a_plan_says_what_to_record_and_what_it_would_leave_open(tmp_path):
    """The widest wanted interval is named; what cannot be played is listed with the reason."""
    steps = [Step("squat", "floor", 5.0, {"armature": 0.4, "viscous_friction": 0.2})]
    found = [PlannedRecording("squat", "floor", 5.0, np.diag([4.0, 9.0]))]
    report_design(steps, found, ["armature", "viscous_friction"], {"sway": "It falls."}, RunFolder(tmp_path, {}), 1.0)
    text = read(tmp_path)
    assert "Record squat: 5 s of robot time." in text
    assert "Afterwards, the widest expected interval, that of the armature, is 40 % of its range." in text
    assert "Omitted: sway. It falls." in text
