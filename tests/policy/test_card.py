"""Cards of policies: their first line, and what a robot must not run."""

import dataclasses

import pytest

from op3.policy import PolicyBundle
from op3.policy.card import CARD, Card, check_card, find_card
from op3.robot import asset_path
from tests.envs.holding import holding_bundle


@pytest.fixture
def bundle() -> PolicyBundle:
    """A policy that holds the stand pose."""
    return holding_bundle()


def card_of(bundle: PolicyBundle, **changed) -> Card:
    known = dict(verdict="STANDS", policy=bundle.fingerprint, task="balance", model="paper", robots=50)
    return Card(**{**known, "self_contact": 0.01, "penetration": 0.001, "cost": {"current": 0.2}, **changed})


def test_round_trip(bundle, tmp_path):
    """The first line is the verdict alone, and the file gives the same card back."""
    card = card_of(bundle)
    text = card.save(bundle.save(tmp_path / "bundle")).read_text()
    assert text.splitlines()[:2] == ["STANDS", "---"]
    assert find_card(tmp_path / "bundle") == card
    assert check_card(tmp_path / "bundle", bundle) == card


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"self_contact": 0.0201}, "touches itself in 2.0 % of the steps in simulation; 2 % are allowed"),
        ({"penetration": 0.0021}, "overlaps itself by 2.1 mm in simulation; 2 mm are allowed"),
        ({"verdict": "FALLS"}, "falls in simulation according to its card"),
        ({"policy": "0123456789abcdef"}, "has the card of another policy"),
    ],
)
def test_what_a_robot_must_not_run(bundle, tmp_path, changed, sentence):
    """One sentence with the number, its limit and a remedy."""
    folder = bundle.save(tmp_path / "bundle")
    card_of(bundle, **changed).save(folder)
    with pytest.raises(
        ValueError, match=f"{sentence}.*: train another policy, or evaluate this one again with op3 evaluate"
    ):
        check_card(folder, bundle)


def test_other_weights_are_another_policy(bundle):
    """A weight that differs in its last bit, or another action map, changes the fingerprint."""
    weights = {name: tensor.clone() for name, tensor in bundle.weights.items()}
    weights["layer_1.bias"][0] += 1e-6
    assert PolicyBundle(bundle.manifest, weights).fingerprint != bundle.fingerprint
    manifest = dataclasses.replace(bundle.manifest, clip=5.0)
    assert PolicyBundle(manifest, bundle.weights).fingerprint != bundle.fingerprint
    assert PolicyBundle(bundle.manifest, bundle.weights).fingerprint == bundle.fingerprint


def test_a_policy_without_a_card(bundle, tmp_path):
    """It is not run, and the sentence says how a card is made."""
    folder = bundle.save(tmp_path / "bundle")
    with pytest.raises(ValueError, match=r"has no card .*op3 evaluate policy=.* task=balance card=true"):
        check_card(folder, bundle)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "it must have a line WALKS, STANDS or FALLS, a line ---, and the fields"),
        ("RUNS\n---\n{format: op3-card/1, policy: x, task: walk, model: paper, robots: 1}", "verdict must be one of"),
        ("WALKS\n---\n{format: op3-card/0}", "format must be 'op3-card/1'"),
        ("WALKS\n---\n{format: op3-card/1, self_contact: 2", "invalid YAML"),
        ("WALKS\n---\n{format: op3-card/1, policy: x, task: walk, model: paper, robots: 1, self_contact: 2,"
         " penetration: 0}", "self_contact must be at most 1, got 2"),
    ],
)  # fmt: skip
def test_broken_cards(bundle, tmp_path, text, sentence):
    """The file, the field and the remedy."""
    folder = bundle.save(tmp_path / "bundle")
    (folder / CARD).write_text(text)
    with pytest.raises(ValueError, match=rf"card.yaml: policy card: .*{sentence}.*; write it again with op3 evaluate"):
        find_card(folder)


@pytest.mark.parametrize(("name", "verdict"), [("balance", "STANDS"), ("walk", "WALKS")])
def test_the_shipped_policies(name, verdict):
    """Their cards are of their own weights, and a robot may run them."""
    folder = asset_path(f"policies/{name}/manifest.yaml").parent
    assert check_card(folder, PolicyBundle.load(folder)).verdict == verdict
