"""A step of torch operations in numpy: the same numbers in every step, or a refusal."""

from functools import partial

import numpy as np
import pytest
import torch

from op3.servo import Signals, compiled_step, fused
from op3.servo.compiled_step import CompiledStep
from op3.servo.recording import Untranslatable

SHAPE = (2, 3)
SHARE = torch.full(SHAPE, 0.5, dtype=torch.float64)


def signals(seed: int = 0) -> Signals:
    """Random joint states, and two memories."""
    generator = torch.Generator().manual_seed(seed)
    made = Signals.zeros(*SHAPE)
    made.position, made.velocity = torch.randn(2, *SHAPE, generator=generator, dtype=torch.float64)
    made.state = {"one": torch.randn(SHAPE, generator=generator, dtype=torch.float64)}
    made.state["line"] = torch.randn(3, *SHAPE, generator=generator, dtype=torch.float64)
    return made


def late(s: Signals) -> None:
    s.speed, s.state["one"] = s.state["one"], s.velocity * 2.0


def late_by_two(s: Signals) -> None:
    s.speed = s.state["line"][1]
    s.state["line"] = torch.stack([s.velocity, *s.state["line"][:-1].unbind()])


def remembered(s: Signals) -> None:
    s.speed = s.state["one"] - s.position
    s.state["one"] = s.position.clone()


def handed_on(s: Signals) -> None:
    s.speed = s.state["one"] + s.velocity
    s.state["one"], s.state["line"] = s.state["line"][0], s.state["line"] * 0.9


def summed(s: Signals) -> None:
    s.speed = s.velocity * s.velocity.abs().sum()


def first_joint(s: Signals) -> None:
    s.speed = s.velocity * s.position[0, 0]


def options(s: Signals) -> None:
    added = torch.add(s.velocity, s.position, alpha=2.0)
    s.speed = torch.rsub(s.velocity, added, alpha=3.0) + torch.full_like(s.velocity > 0, 0.5, dtype=torch.float64)


def cast(s: Signals) -> None:
    s.speed = (s.velocity * 10).to(torch.int64).to(torch.float64) + (s.velocity > 0).to(torch.float64)


def spread(s: Signals) -> None:
    s.speed = s.velocity.sum(0).expand(2, 3) + s.velocity[:, :1].expand(-1, 3)


def limited(s: Signals) -> None:
    limits = torch.where(s.velocity > 0, SHARE, -s.velocity)
    s.speed = torch.clamp(s.velocity, -SHARE, limits).mT.mT + torch.addcmul(s.velocity, SHARE, SHARE)


@pytest.mark.parametrize(
    "step",
    [late, late_by_two, remembered, handed_on, summed, first_joint, options, cast, spread, limited],
    ids=lambda step: step.__name__,
)
@pytest.mark.parametrize("in_blocks", [False, True])
def test_numpy_does_what_torch_does(step, in_blocks, monkeypatch):
    """Over many steps with new states, outputs and memory are those of torch, whatever is a view of what."""
    monkeypatch.setattr(fused, "FEWEST", 1)
    plain, translated = signals(), signals()
    compiled = CompiledStep(step, translated, ("speed",))
    for seed in range(1, 6):
        new = signals(seed)
        for name in ("position", "velocity"):
            setattr(plain, name, getattr(new, name))
            if name in compiled.inputs:
                compiled.inputs[name][...] = getattr(new, name).numpy()
        step(plain)
        (compiled if in_blocks else compiled.call_by_call)()
        np.testing.assert_allclose(compiled.outputs["speed"], plain.speed.numpy(), rtol=1e-13)
        for name, memory in plain.state.items():
            np.testing.assert_allclose(compiled.state.get(name, compiled.next_state[name]), memory.numpy(), rtol=1e-13)


@pytest.mark.parametrize(
    ("step", "reason"),
    [
        (lambda s: s.velocity.add_(1.0), "in place"),
        (lambda s: setattr(s, "speed", s.velocity.cumsum(1)), "cumsum"),
        (lambda s: setattr(s, "speed", s.velocity * float(s.position.sum())), "numbers decide"),
        (lambda s: setattr(s, "speed", s.velocity * len(s.position.nonzero())), "numbers decide"),
        (lambda s: setattr(s, "speed", torch.addcmul(s.velocity, s.velocity, s.velocity, value=2)), "value"),
        (lambda s: setattr(s, "speed", s.velocity if bool((s.velocity > 0).all()) else s.position), "numbers decide"),
    ],
    ids=["in place", "unknown", "a number", "a shape", "an option", "a branch"],
)
def test_refusals_name_the_operation(step, reason):
    """What is no fixed list of known operations is refused."""
    with pytest.raises(Untranslatable, match=reason):
        CompiledStep(step, signals(), ("speed",))


def test_a_translation_that_differs_is_refused(monkeypatch):
    """Numpy's numbers are held against torch's before anyone relies on them."""
    monkeypatch.setitem(compiled_step._UNARY, "abs", np.negative)
    with pytest.raises(Untranslatable, match="other numbers"):
        CompiledStep(lambda s: setattr(s, "speed", s.velocity.abs()), signals(), ("speed",))


def test_numbers_that_do_not_change_are_computed_once():
    """Of a step in which parameters meet parameters, only what depends on the signals is left."""

    def step(s: Signals) -> None:
        s.speed = s.velocity * torch.exp(SHARE * SHARE) + SHARE

    compiled = CompiledStep(step, signals(), ("speed",))
    compiled.inputs["velocity"][...] = 2.0
    compiled()
    np.testing.assert_allclose(compiled.outputs["speed"], 2.0 * np.exp(0.25) + 0.5, rtol=1e-15)
    assert len(compiled) == 2  # a product and a sum


def test_single_precision_stays_single():
    """Windows are simulated in single precision: constants do not lift it."""
    made = Signals.zeros(*SHAPE, dtype=torch.float32)
    compiled = CompiledStep(
        lambda s: setattr(s, "speed", torch.where(s.velocity > 0, 0.5, s.velocity)), made, ("speed",)
    )
    assert compiled.outputs["speed"].dtype == np.float32


@pytest.mark.parametrize("robots", [2, 90])
def test_a_step_with_other_parameters_is_a_new_one(robots, monkeypatch):
    """Renewed, it does what one translated with these parameters does, bit by bit; one number each, and by block."""
    monkeypatch.setattr(fused, "FEWEST", 1)

    def step(gain: torch.Tensor, limit: torch.Tensor, s: Signals) -> None:
        scale = torch.exp(gain) * 2.0  # of parameters alone
        s.speed = torch.minimum(s.velocity * scale - s.position * gain, limit) + s.velocity.abs() * scale

    def parameters(seed: int) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(seed)
        gain = torch.randn(2, 3, generator=generator, dtype=torch.float64).repeat_interleave(robots, 0)
        return {
            "gain": gain,
            "limit": torch.rand(2 * robots, 3, generator=generator, dtype=torch.float64)[:, :1] + gain,
        }

    def compiled(given: dict[str, torch.Tensor]) -> CompiledStep:
        start = Signals.zeros(2 * robots, 3)
        start.position, start.velocity = torch.zeros(2, 3, 2 * robots, dtype=torch.float64).mT  # robots side by side
        return CompiledStep(partial(step, given["gain"], given["limit"]), start, ("speed",), parameters=given)

    renewed = compiled(parameters(0))
    for seed in range(1, 4):
        other = parameters(seed)
        new = compiled(other)
        assert renewed.renew(other)
        for name, array in new.inputs.items():
            array[...] = np.random.default_rng(seed).normal(size=array.shape)
            renewed.inputs[name][...] = array
        new()
        renewed()
        np.testing.assert_array_equal(renewed.outputs["speed"], new.outputs["speed"])
    assert torch.equal(other["gain"], parameters(3)["gain"])  # nobody else's tensors were written


@pytest.mark.parametrize("reason", ["shape", "blocks", "number", "aliased", "branch", "unknown"])
def test_parameters_of_another_kind_need_a_new_step(reason, monkeypatch):
    """Nothing is renewed that was translated for other shapes, blocks, numbers or branches."""
    monkeypatch.setattr(fused, "FEWEST", 1)
    gain = torch.ones(80, 3, dtype=torch.float64)
    given = {"gain": gain, "limit": torch.tensor(1.0, dtype=torch.float64), "other": 2.0 * gain}
    if reason == "aliased":
        given["other"] = gain

    def step(s: Signals) -> None:
        s.speed = torch.minimum(s.velocity * given["gain"], given["limit"]) + s.position.abs() * given["other"]
        if reason == "branch" and bool(given["gain"].all()):
            s.speed = -s.speed

    start = Signals.zeros(80, 3)
    start.position, start.velocity = torch.zeros(2, 3, 80, dtype=torch.float64).mT  # robots side by side
    compiled = CompiledStep(step, start, ("speed",), parameters=given)
    later = {name: value.clone() for name, value in given.items()}
    if reason == "branch":
        assert not compiled.renew(later)
        return
    assert compiled.renew(later)
    if reason == "shape":
        later["gain"] = later["gain"][:40]
    elif reason == "blocks":
        later["gain"][7] = 3.0
    elif reason == "number":
        later["limit"] += 1.0
    elif reason == "aliased":
        later["other"] *= 2.0
    else:
        del later["other"]
    assert not compiled.renew(later)
