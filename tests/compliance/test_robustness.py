"""Variations of a robot, and a card measured on few of them."""

from pathlib import Path

import pytest
import yaml

from op3.compliance import robustness
from op3.compliance.robustness import Passed, Variation, make_card, verdict
from op3.envs.actors import Actor
from op3.sim import load_model
from op3.tasks import find_task
from tests.envs.holding import holding_bundle

PAPER = load_model("paper")
SHIPPED = yaml.safe_load((Path(__file__).resolve().parents[2] / "conf/variations/robustness.yaml").read_text())


def test_values_are_added_and_scaled():
    """Latency of 6 ms and 4 more, a battery of 11.1 V and 10 % less; the effect of a tilted floor is put in."""
    changed = Variation(
        add={"command_latency": 0.004, "ground_pitch": 0.1}, scale={"bus_voltage": 0.9, "coulomb_friction": 2.0}
    ).model(PAPER)
    assert changed.value("command_latency") == pytest.approx(0.010)
    assert changed.bus_voltage == pytest.approx(9.99)
    assert changed.value("coulomb_friction") == pytest.approx(0.26)
    assert (changed.value("ground_pitch"), changed.value("ground_roll")) == (pytest.approx(0.1), 0.0)
    assert "ground_tilt" not in PAPER.effect_names


def test_an_effect_that_is_put_in_begins_where_it_does_nothing():
    """A model without latency and 4 ms more of it has 4 ms, not 4 more than the usual 6."""
    changed = Variation(add={"command_latency": 0.004}).model(PAPER.without("latency"))
    assert changed.value("command_latency") == pytest.approx(0.004)


def test_what_is_impossible_is_named():
    """A parameter that there is not, with the nearest name, and a value that physics forbids."""
    with pytest.raises(ValueError, match=r"'comand_latency', but no effect has such a parameter.*command_latency"):
        Variation(add={"comand_latency": 0.004}).model(PAPER)
    with pytest.raises(ValueError, match=r"command_latency must be between 0 and 0.024 s, got -0.994"):
        Variation(add={"command_latency": -1.0}).model(PAPER)


def test_shipped_variations_change_what_they_say():
    """Each one differs from the robot as it is, and low friction is 0.5 on a floor of 0.8."""
    for name, values in SHIPPED.items():
        one = Variation(**values)
        assert one.model(PAPER) != PAPER or one.gain_scale != 1.0, name
        assert one.text
    assert 0.8 * (1 + SHIPPED["low_friction"]["add"]["foot_friction_error"]) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("task", "upright", "successes", "word"),
    [
        ("walk", 50, 45, "WALKS"),
        ("walk", 45, 44, "STANDS"),
        ("balance_eval", 45, 45, "STANDS"),
        ("walk", 44, 0, "FALLS"),
    ],
)
def test_the_word_on_the_first_line(task, upright, successes, word):
    """Nine of ten are enough: walked, stood, or neither."""
    assert verdict(Passed(50, upright, successes, 0.0), find_task(task)) == word


def test_a_card_of_a_policy_that_holds(monkeypatch):
    """It stands on the floor, and not on a slope of 60 degrees; its numbers are those of a robot that does not move."""
    monkeypatch.setattr(robustness, "PUSH_RUNGS", 2)
    bundle, task = holding_bundle("walk"), find_task("walk", duration=1.5)
    card = make_card(
        Actor("hold", bundle, bundle.manifest.action_map),
        "paper",
        PAPER,
        task,
        {"cliff": Variation(text="steep", add={"ground_pitch": 1.0})},
        {"command": "none"},
        robots=2,
        seed=5,
        report=lambda line: None,
        num_threads=1,
    )
    assert (card.verdict, card.self_contact, card.penetration) == ("STANDS", 0.0, 0.0)
    assert card.policy == bundle.fingerprint
    assert card.validity["clearance"] is None
    assert card.validity["collision_ahead"] == 0.0
    assert card.robustness["nominal"]["success"] == 0.0  # upright, but not a metre forward
    assert card.robustness["cliff"]["text"] == "steep"
    assert card.pushes["robots"] == 16
    low, high = card.pushes["mean"][1:]
    assert low <= card.pushes["mean"][0] <= high
    assert 0 < card.cost["current"] < 1
    assert card.made == {"command": "none"}
