"""Transfers and their story."""

from dataclasses import replace
from pathlib import Path

import pytest

from op3.report import RunFolder, read_result
from op3.report.transfer_page import report_transfers
from op3.transfer.attempt import Learned, Transfer


def transfer(expected, actual, upright=(True,), walked=None):
    paths = (Path("policy"), "model.yaml")
    return Transfer(*paths, expected, actual, upright, Path("robot"), walked=walked)


def test_balancing_succeeds_at_four_fifths():
    """The mean return on the robot must reach 80 % of the expected one: 200 of 250 do, 199 do not."""
    assert transfer([240.0, 260.0], [190.0, 210.0]).success
    assert not transfer([240.0, 260.0], [189.0, 209.0]).success
    assert transfer([240.0, 260.0], [190.0, 210.0]).share == pytest.approx(0.8)


def test_walking_succeeds_with_eight_of_ten():
    """Walking is judged by the episodes that walked on, whatever the returns, and however many stand."""
    upright = [True] * 10
    assert transfer([250.0], [10.0], upright, [True] * 8 + [False] * 2).success
    assert not transfer([250.0], [250.0], upright, [True] * 7 + [False] * 3).success


def test_falls_on_the_way_to_the_end_pose_are_falls():
    """Three of four that stood and then fell are in the verdict, which says the interval of the share.

    Means 250 and 225, standard deviations 10 and 20: share 0.9, relative errors 10 / 2 / 250 and 20 / 2 / 225 of the
    means, together 0.0487; times Student's 3.182 and the share 0.14.
    """
    expected, actual = (
        [250 + 10 * d for d in (-(1.5**0.5), 0, 0, 1.5**0.5)],
        [225 + 20 * d for d in (-(1.5**0.5), 0, 0, 1.5**0.5)],
    )
    one = replace(transfer(expected, actual, [True, False, False, False]), afterwards=3)
    assert one.interval == pytest.approx((0.761, 1.039), abs=1e-3)
    assert one.success
    assert not one.settled
    said = "the robot reaches 90 % (95 %: 76 to 104 %) of the expected return"
    assert one.achieved == f"{said}, and falls in 3 of 4 episodes, 3 of them while moving to the end pose"


def told(folder: Path, transfers, learned=None, condition="reidentified", **more) -> str:
    """The page of transfers."""
    asked = {"task": "balance", "world": "robot_4", "condition": condition, "budget": "demo"}
    timed = {"seconds": {"0_train": 10.0}, "processor_seconds": {"0_train": 17.0}}
    run = RunFolder(folder, {"seed": 0})
    report_transfers(transfers, learned or Learned(), run, asked=asked, **timed, **more)
    return (folder / "index.html").read_text()


def test_the_story_begins_with_the_outcome(tmp_path):
    """The page says how the last transfer ended, and names both shares; the numbers hold every transfer."""
    failed, good = transfer([250.0], [100.0], [False]), transfer([250.0], [240.0])
    text = told(tmp_path, [failed, good])
    share = "the robot reaches {} % of the expected return"
    assert f"the policy succeeds: {share.format(96)}." in text
    assert f"In the first transfer, {share.format(40)}, and falls in 1 of 1 episodes." in text
    assert "1 episodes decide instead of the paper" in text
    assert "Learned in round" not in text
    numbers = read_result(tmp_path / "result.yaml")
    assert (numbers["transfer_0.share"], numbers["transfer_1.success"], numbers["rounds"]) == (0.4, True, 1)
    first = told(tmp_path, [good], Learned(spared=True), what="Balancing. The robot is real.")
    assert "The model needed no correction. Balancing. The robot is real." in first
    assert "The first transfer fails" in told(tmp_path, [failed], condition="excitation_only")
    walks = transfer([250.0], [240.0] * 10, [True] * 10, [True] * 7 + [False] * 3)
    said = "The first transfer fails: 7 of 10 episodes walk until the end (95 %: 40 to 89 %)"
    assert said in told(tmp_path, [walks])


def test_the_page_shows_films_and_what_was_learned(tmp_path):
    """Films of the first and the last transfer are on the page, as are distances and parameters."""
    films = {name: tmp_path / f"{name}.mp4" for name in ("a", "b", "c")}
    for film in films.values():
        film.touch()
    first = replace(transfer([250.0], [100.0]), film=films["a"], robot_film=films["b"])
    last = replace(transfer([250.0], [240.0]), film=films["c"], robot_film=tmp_path / "missing.mp4")
    found = {
        **{f"{key}.{when}": value for key, value in (("distance", 2.0), ("fresh", 3.0), ("excitation", 0.5))
           for when in ("excitation_only", "reidentified")},
        "fresh.noise": 1.0,
        "normalised.excitation_only.torque_constant": 0.2,
        "normalised.reidentified.torque_constant": 0.3,
        "accepted": False,
    }  # fmt: skip
    learned = Learned({1: found}, {1: "A spring is missing."}, ["One episode does not count."])
    transfers = [first, replace(last, began_with="the policy of round 0")]
    text = told(
        tmp_path, transfers, learned, learning={"round 0": ([0, 1], [10.0, 20.0])}, following=["op3 view somewhere"]
    )
    for name in films:
        assert f'src="{name}.mp4"' in text
    assert "missing" not in text.replace("spring is missing", "")
    for said in (
        "Learned in round 1", "A spring is missing.", "One episode does not count.", "the policy of round 0",
        "No candidate was better", "op3 view somewhere", "during training", "torque constant", "a distance of 1", "17",
    ):  # fmt: skip
        assert said in text
