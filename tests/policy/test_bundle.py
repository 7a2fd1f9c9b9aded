"""A policy as a folder."""

import dataclasses

import numpy as np
import pytest
import torch

from op3.policy import ActionMap, Manifest, PolicyBundle, Training
from op3.policy.bundle import weight_shapes
from op3.robot import load_robot

LAYOUT = {"key_points": 36, "command": 20, "orientation": 3, "angular_velocity": 3}
MANIFEST = Manifest(
    task="balance",
    layout=LAYOUT,
    history=1,
    action_map=ActionMap.around_stand(load_robot("op3")),
    hidden=(256, 256),
    training=Training(
        model="paper", seed=3, steps=1000, command="python experiments/train.py", settings={"batch": 256}
    ),
)


def random_weights(manifest: Manifest = MANIFEST, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    weights = {
        name: torch.randn(shape, generator=generator) / shape[-1] ** 0.5
        for name, shape in weight_shapes(manifest).items()
    }
    weights["observation.scale"] = weights["observation.scale"].abs() + 0.5
    return weights


@pytest.fixture
def bundle():
    return PolicyBundle(MANIFEST, random_weights())


def test_round_trip(bundle, tmp_path):
    """A bundle that was saved and loaded has the same manifest and acts to the last bit the same."""
    loaded = PolicyBundle.load(bundle.save(tmp_path / "policy"))
    observation = torch.randn(5, 124, generator=torch.Generator().manual_seed(1))
    assert loaded.manifest == MANIFEST
    assert torch.equal(loaded.act(observation), bundle.act(observation))


def test_action_is_tanh_of_the_network(bundle):
    """Actions equal tanh of a network built by hand from torch.nn layers, in numpy and torch, single and batch."""
    weights = bundle.weights
    network = torch.nn.Sequential(
        torch.nn.Linear(124, 256), torch.nn.ReLU(), torch.nn.Linear(256, 256), torch.nn.ReLU(), torch.nn.Linear(256, 20)
    )
    for number, layer in enumerate(module for module in network if isinstance(module, torch.nn.Linear)):
        layer.weight.data, layer.bias.data = weights[f"layer_{number}.weight"], weights[f"layer_{number}.bias"]
    observation = 3 * torch.randn(4, 124, generator=torch.Generator().manual_seed(2))
    normalised = ((observation - weights["observation.mean"]) / weights["observation.scale"]).clamp(-10, 10)
    expected = torch.tanh(network(normalised)).detach()
    torch.testing.assert_close(bundle.act(observation), expected)
    single = bundle.act(observation[0].double().numpy())
    assert single.dtype == np.float64
    np.testing.assert_allclose(single, expected[0], atol=1e-6)


def test_non_finite_and_wrong_observations_are_refused(bundle):
    """An observation with a NaN or of another size is refused with the reason."""
    with pytest.raises(ValueError, match="not finite"):
        bundle.act(np.full(124, np.nan))
    with pytest.raises(ValueError, match=r"needs observations of 124 numbers, got an array of shape \(62,\)"):
        bundle.act(np.zeros(62))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda w: w.pop("layer_1.bias"), "tensor layer_1.bias is missing"),
        (lambda w: w.update(extra=torch.zeros(1)), "unknown tensor extra"),
        (lambda w: w.update({"layer_0.weight": torch.zeros(256, 100)}), r"layer_0.weight is \(256, 100\), but"),
        (lambda w: w["layer_2.bias"].fill_(torch.nan), "layer_2.bias contains non-finite values"),
        (lambda w: w["observation.scale"].zero_(), "observation.scale contains non-positive values"),
    ],
)
def test_broken_weights_are_refused(bundle, tmp_path, spoil, message):
    """Weights that are missing, unknown, of another shape or not finite are refused, naming file and tensor."""
    folder = bundle.save(tmp_path / "policy")
    weights = random_weights()
    spoil(weights)
    torch.save(weights, folder / "policy.pt")
    with pytest.raises(ValueError, match=message) as error:
        PolicyBundle.load(folder)
    assert str(folder / "policy.pt") in str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("history: 1", "history: 2", "observation_size is 124, but layout and history give 186"),
        ("history: 1", "history: -1", "history must be at least 0, got -1"),
        ("format: op3-policy/1", "format: other", "format must be"),
        ("task: balance\n", "", "task is missing"),
        ("clip: 10.0", "clip: .nan", "clip must be a finite number"),
        ("policy_rate: 31.25", "policy_rate: 30.0", "does not divide"),
        ("normalisation: fixed", "colour: red\nnormalisation: fixed", "colour is not a field"),
        ("hidden: [256, 256]", "hidden: [256, 256", "not valid YAML"),
    ],
)
def test_broken_manifests_are_refused(bundle, tmp_path, old, new, message):
    """A manifest with a missing, unknown or impossible field is refused, naming file and field."""
    folder = bundle.save(tmp_path / "policy")
    text = (folder / "manifest.yaml").read_text()
    assert old in text
    (folder / "manifest.yaml").write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message) as error:
        PolicyBundle.load(folder)
    assert str(folder / "manifest.yaml") in str(error.value)


def test_missing_and_torn_files_are_refused(bundle, tmp_path):
    """A folder without a bundle, and a weights file cut short, are refused in one sentence."""
    with pytest.raises(FileNotFoundError, match=r"no manifest\.yaml there"):
        PolicyBundle.load(tmp_path)
    folder = bundle.save(tmp_path / "policy")
    (folder / "policy.pt").write_bytes((folder / "policy.pt").read_bytes()[:1000])
    with pytest.raises(ValueError, match="not a valid weights file"):
        PolicyBundle.load(folder)
    (folder / "policy.pt").write_bytes(b"broken")
    with pytest.raises(ValueError, match="not a valid weights file"):
        PolicyBundle.load(folder)


def test_no_bundle_is_overwritten_unasked(bundle, tmp_path):
    """Saving over a bundle is refused unless asked for."""
    folder = bundle.save(tmp_path / "policy")
    with pytest.raises(FileExistsError, match="already"):
        bundle.save(folder)
    other = dataclasses.replace(MANIFEST, task="walk")
    PolicyBundle(other, random_weights(other)).save(folder, overwrite=True)
    assert PolicyBundle.load(folder).manifest.task == "walk"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"layout": {**LAYOUT, "phase": 2}}, "field layout of its manifest is key_points 36.*phase 2; the policy was"),
        ({"history": 3}, "field history of its manifest is 1, expected 3"),
        ({"policy_rate": 50.0}, "field policy_rate of its manifest is 31.25 Hz, expected 50 Hz"),
    ],
)
def test_a_robot_that_the_policy_was_not_made_for(changes, message):
    """What differs is named with both values before anything moves."""
    here = {"layout": LAYOUT, "history": 1, "command_rate": 125.0, "policy_rate": 31.25}
    MANIFEST.check_fits(**here)
    with pytest.raises(ValueError, match=message):
        MANIFEST.check_fits(**{**here, **changes})


def test_shipped_policies_are_found_from_any_folder(tmp_path, monkeypatch):
    """Their path is that of a checkout, and one of the working folder comes first."""
    monkeypatch.chdir(tmp_path)
    shipped = PolicyBundle.load("assets/policies/balance")
    assert shipped.manifest.task == "balance"
    with pytest.raises(FileNotFoundError, match="policies/none"):
        PolicyBundle.load("assets/policies/none")
    (tmp_path / "assets/policies/balance").mkdir(parents=True)
    with pytest.raises(FileNotFoundError):
        PolicyBundle.load("assets/policies/balance")
