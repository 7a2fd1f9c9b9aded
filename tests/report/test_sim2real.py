"""Transfers and their story."""

from pathlib import Path

import pytest

from op3.report.sim2real import Transfer, story


def transfer(expected, actual, upright=(True,), walking=False):
    paths = (Path("policy"), "model.yaml")
    return Transfer(*paths, expected, actual, upright, Path("robot"), Path("film.png"), walking=walking)


def test_balancing_succeeds_at_four_fifths():
    """The mean return on the robot must reach 80 % of the promised one: 200 of 250 do, 199 do not."""
    assert transfer([240.0, 260.0], [190.0, 210.0]).success
    assert not transfer([240.0, 260.0], [189.0, 209.0]).success
    assert transfer([240.0, 260.0], [190.0, 210.0]).share == pytest.approx(0.8)


def test_walking_succeeds_with_eight_of_ten():
    """Walking is judged by falls alone, whatever the returns."""
    assert transfer([250.0], [10.0], [True] * 8 + [False] * 2, walking=True).success
    assert not transfer([250.0], [250.0], [True] * 7 + [False] * 3, walking=True).success


def test_the_story_begins_with_the_outcome(tmp_path):
    """The page says how the last transfer ended, and names both shares."""
    transfers = [transfer([250.0], [100.0], [False]), transfer([250.0], [240.0])]
    page = story(
        tmp_path, transfers, {"0_train": 10.0}, condition="reidentified", budget="demo", provenance={"seed": 0}
    )
    text = page.write(tmp_path / "index.html").read_text()
    assert "the policy succeeds: the robot reaches 96 % of the promised return, 40 % at first" in text
    failed = story(tmp_path, transfers[:1], {}, condition="excitation_only", budget="demo", provenance={})
    assert "The first transfer fails" in failed.write(tmp_path / "failed.html").read_text()
