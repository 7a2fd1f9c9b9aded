"""Runs of numpy calls, block by block: numpy's numbers, bit by bit, whatever lies where in memory."""

import copy
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from op3.robot import JOINTS
from op3.servo import Effect, ServoLaw, Signals, catalogue, fused
from op3.servo.block_run import OPERATIONS, UNARY, BlockRun
from op3.servo.compiled_step import CompiledStep
from op3.servo.fused import fuse, pick
from op3.sim import load_model

ROBOTS, NUM_JOINTS = 300, 6
"""More than a block, and no multiple of it."""

SHAPE = (ROBOTS, NUM_JOINTS)


def array(rng: np.random.Generator, order: str = "joint", kind: str = "<f4") -> np.ndarray:
    """Random numbers with some that are alike, zero or none."""
    values = rng.choice([-2.0, -0.5, 0.0, 0.5, 1.0, np.nan, np.inf], size=SHAPE)
    values = np.where(rng.random(SHAPE) < 0.5, rng.normal(size=SHAPE), values).astype(kind)
    return np.asfortranarray(values) if order == "joint" else np.ascontiguousarray(values)


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize("function", OPERATIONS, ids=lambda function: function.__name__)
def test_every_operation_is_numpys(function, kind):
    """Bits are alike, also of what is not a number, for every order in memory and with conditions."""
    rng = np.random.default_rng(3)
    for orders in (("joint", "joint"), ("robot", "joint"), ("robot", "robot")):
        arguments = [array(rng, order, kind) for order in orders][: 1 if function in UNARY else 2]
        with np.errstate(all="ignore"):
            expected = function(*arguments)
            out = np.zeros_like(expected)
            calls = [partial(function, *arguments, out=out)] * fused.FEWEST
            for call in calls:
                call()
            (run,) = fuse(calls, arguments[0], [out], arguments)
            out[...] = 7
            assert isinstance(run, BlockRun)
            run()
        np.testing.assert_array_equal(out, expected)


def test_a_chain_with_every_kind_of_call():
    """Views, conditions, sums over joints and layers, entries that are picked, and memory that is written in parts."""
    rng = np.random.default_rng(4)
    line = np.moveaxis(np.stack([array(rng).T for _ in range(12)]).reshape(4, 3, NUM_JOINTS, ROBOTS), -1, -2)
    index, weights = np.array([2]), np.nan_to_num(line[0] * 0.5, posinf=1.0)
    q, v = (np.nan_to_num(array(rng), posinf=1.0) for _ in range(2))
    picked, scaled = np.empty((1, *line.shape[1:]), "<f4").transpose(0, 1, 2, 3), np.empty_like(weights)
    delayed, product, size, whole = (np.empty_like(q) for _ in range(4))
    total, condition = np.empty((ROBOTS, 1), "<f4"), np.empty_like(q, dtype=bool)
    kept = np.empty((2, ROBOTS, NUM_JOINTS), "<f4")
    calls = [
        partial(pick, np.nan_to_num(line, posinf=1.0), index, 0, out=picked),
        partial(np.multiply, picked[0], weights, out=scaled),
        partial(np.sum, scaled, (0,), keepdims=False, out=delayed),
        partial(np.multiply, delayed, 0.25, out=product),
        partial(np.absolute, product, out=size),
        partial(np.sum, size, (-1,), keepdims=True, out=total),
        partial(np.greater, q, total, out=condition),
        partial(np.copyto, whole, v),
        partial(np.copyto, whole, 0.0, where=condition),
        partial(np.subtract, whole, product, out=product),
        partial(np.copyto, kept[0], product),
        partial(np.copyto, kept[1], whole),
    ]

    def results(what) -> list[np.ndarray]:
        index[0] = 1
        for call in what:
            call()
        return [kept.copy(), condition.copy()]

    expected = results(calls)
    (run,) = fuse(calls, q, [kept, condition], [q, v, line, index])
    kept[...], condition[...] = 7.0, False
    for found, known in zip(results([run]), expected, strict=True):
        np.testing.assert_array_equal(found, known)


def laws() -> list[str]:
    """Effects that act on a servo, not on the trunk's sensors."""
    return [name for name, effect in catalogue().items() if effect.sense_trunk is Effect.sense_trunk]


def law_of(name: str, num_robots: int, group: int, seed: int, order: str) -> tuple[ServoLaw, Signals]:
    """The law of the paper's model with one effect more, groups of robots having parameters of their own.

    In memory a joint's robots lie together, or a robot's joints.
    """
    model, effect, joints = load_model("paper"), catalogue()[name], JOINTS[:NUM_JOINTS]
    if name not in model.effect_names:
        model = model.with_effect(effect())
    law = ServoLaw(model.effects, 0.001, 0.008, joints)
    rng = np.random.default_rng(seed)
    values = {}
    for known, value in model.parameters().items():
        middle = 0.5 * (value.low + value.high)
        drawn = middle + 0.2 * (value.high - value.low) * rng.uniform(-1, 1, (num_robots // group, NUM_JOINTS))
        spread = torch.from_numpy(drawn.T.astype("<f4"))[:, :, None].expand(-1, -1, group)
        values[known] = spread.reshape(NUM_JOINTS, -1).T
    law.set_parameters(values)
    signals = Signals.zeros(num_robots, NUM_JOINTS, dtype=torch.float32)
    for signal in ("position", "velocity", "position_target", "load_torque"):
        drawn = torch.from_numpy(rng.normal(size=(NUM_JOINTS, num_robots)).astype("<f4") * 0.3).T
        setattr(signals, signal, drawn if order == "joint" else drawn.contiguous())
    signals.torque_enable = torch.ones_like(signals.position)
    signals.bus_voltage = torch.full_like(signals.position, 12.0)
    law.reset(signals)
    law.tick(signals)
    law.act(signals)
    return law, signals


@settings(max_examples=12, deadline=None)
@given(
    name=st.sampled_from(laws()),
    seed=st.integers(0, 1000),
    group=st.sampled_from([1, 50, 300]),
    order=st.sampled_from(["joint", "robot"]),
)
def test_every_law_is_the_same_in_blocks(name, seed, group, order):
    """The law of any effect, with parameters that change from robot to robot or in runs, over several steps."""
    stepped = []
    for in_runs in (False, True):
        law, signals = law_of(name, ROBOTS, group, seed, order)
        step = CompiledStep(law.act, signals, ("applied_torque", "friction_bound", "damping", "current"))
        rng = np.random.default_rng(seed)
        for _ in range(4):
            for signal in ("position", "velocity", "load_torque"):
                if signal in step.inputs:
                    step.inputs[signal][...] = rng.normal(size=SHAPE) * 0.3
            (step if in_runs else step.call_by_call)()
        stepped.append({**step.outputs, **step.next_state})
        assert any(isinstance(call, BlockRun) for call in step._runs)
    for key, value in stepped[0].items():
        np.testing.assert_array_equal(stepped[1][key], value, err_msg=key)


def step_of(law, robots: int = ROBOTS, joints: int = NUM_JOINTS, order: str = "joint", **more) -> CompiledStep:
    """A compiled step that leaves its result in `speed`."""
    rng = np.random.default_rng(5)
    signals = Signals.zeros(robots, joints)
    for name in ("position", "velocity"):
        drawn = torch.from_numpy(rng.normal(size=(joints, robots))).T
        setattr(signals, name, drawn if order == "joint" else drawn.contiguous())
    for name, value in more.items():
        setattr(signals, name, value)
    step = CompiledStep(law, signals, ("speed",))
    for name in ("position", "velocity"):
        if name in step.inputs:
            step.inputs[name][...] = rng.normal(size=(robots, joints))
    return step


def result(work, step: CompiledStep) -> np.ndarray:
    """Bits of what it leaves."""
    work()
    return step.outputs["speed"].copy().view(np.uint64)


def last_robot(s: Signals) -> None:
    doubled = s.velocity * 2.0
    s.speed = (s.position + doubled[-1:]) * 3.0 + 1.0


def turned_over(s: Signals) -> None:
    doubled = s.velocity * 2.0
    s.speed = (s.position + doubled.transpose(0, 1)) * 3.0 + 1.0


def two_truths(s: Signals) -> None:
    either = torch.add(s.velocity > 0, s.position > 0)
    s.speed = either * s.velocity * 2.0 + 1.0


def signed_zeros(s: Signals) -> None:
    s.speed = torch.maximum(s.velocity, torch.zeros_like(s.velocity)).abs() * -0.0 + torch.sign(s.position * 0.0) * 2.0


def summed(s: Signals) -> None:
    s.speed = s.velocity.abs().sum(-1, keepdim=True) * s.position * 0.5 + 1.0


@pytest.mark.parametrize("order", ["joint", "robot"])
@pytest.mark.parametrize(
    ("law", "robots", "joints"),
    [
        (last_robot, 300, 6),
        (turned_over, 300, 300),
        (two_truths, 300, 6),
        (signed_zeros, 300, 6),
        (summed, 64, 20),
        (summed, 3, 200),
        (summed, 257, 1),
        (summed, 1, 20),
    ],
)
def test_corners_are_numpys(law, robots, joints, order):
    """Robots that look at each other, truths that are added, zeros with signs, sums over many joints."""
    step = step_of(law, robots, joints, order)
    expected = result(step.call_by_call, step)
    step.outputs["speed"][...] = 7.0
    np.testing.assert_array_equal(result(step, step), expected)


TABLE = torch.arange(3.0, dtype=torch.float64)[:, None, None].expand(3, 64, 6) * 2.0 + 1.0


@pytest.mark.parametrize("phase", [1, 3])
def test_a_picked_entry_is_not_the_first(phase):
    """A table that is also read directly; what is not in it is refused."""

    def law(s: Signals) -> None:
        first = s.velocity * TABLE[0]
        s.speed = first + 10.0 * (s.velocity * TABLE.index_select(0, s.phase)[0]) + 1.0

    number = torch.ones(1, dtype=torch.int64)
    step = step_of(law, 64, 6, phase=number)
    step.inputs["phase"][...] = phase
    if phase == 3:
        with pytest.raises(IndexError, match="entry 3 of 3"):
            step()
    else:
        expected = result(step.call_by_call, step)
        np.testing.assert_array_equal(result(step, step), expected)


def test_a_run_is_not_copied():
    """It holds addresses of arrays that a copy would leave behind."""
    with pytest.raises(TypeError, match="addresses"):
        copy.deepcopy(step_of(summed))


@pytest.mark.parametrize("robots", [256, 257, 300, 1021])
def test_blocks_are_never_small(robots):
    """Whatever the number of robots, also where parameters come in short runs."""
    for group in (1, robots):
        factor = torch.arange(robots // group, dtype=torch.float64).repeat_interleave(group)[:, None].expand(-1, 6) + 1
        step = step_of(lambda s, f=factor: setattr(s, "speed", (s.velocity * f + 1.0) * f + s.position), robots)
        assert all(run.size >= min(robots, 32) for run in step._runs if isinstance(run, BlockRun))
        expected = result(step.call_by_call, step)
        np.testing.assert_array_equal(result(step, step), expected)
