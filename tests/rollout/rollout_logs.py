"""Logs for the tests: two joints, all channels, plausible numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from op3.rollout import CHANNELS, LogError, Metadata, Rollout, read_episodes

JOINTS = ("l_knee", "r_knee")
RATE = 125.0
SERVO_BENCH = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "servo_bench"


def metadata(**changes: Any) -> Metadata:
    """Metadata of a simulated OP3 on the floor with two joints."""
    fields: dict[str, Any] = dict(joints=JOINTS, robot="simulated", mount="floor", rate=RATE)
    return Metadata(**{**fields, **changes})


def arrays(rows: int = 30, joints: int = 2, seed: int = 0) -> dict[Any, np.ndarray]:
    """Every channel of the schema, [time, last axis]."""
    generator = np.random.default_rng(seed)
    time = np.arange(rows)[:, None] / RATE
    phase = 2 * np.pi * time + np.arange(joints)
    values: dict[Any, np.ndarray] = {
        "time": time,
        ("command", "position"): np.sin(phase + 0.05),
        ("command", "p_gain"): np.full((rows, joints), 6.0),
        ("command", "d_gain"): np.full((rows, joints), 0.1),
        ("command", "torque_enable"): np.ones((rows, joints)),
        ("command", "firmware_gain"): np.full((rows, joints), 800.0),
        ("joint", "position"): np.sin(phase),
        ("joint", "velocity"): 2 * np.pi * np.cos(phase),
        ("joint", "current"): generator.normal(0, 0.5, (rows, joints)),
        ("joint", "duty"): generator.uniform(-1, 1, (rows, joints)),
        ("joint", "load"): generator.normal(0, 0.3, (rows, joints)),
        ("joint", "voltage"): generator.normal(11.1, 0.1, (rows, joints)),
        ("joint", "temperature"): np.full((rows, joints), 40.0),
        ("imu", "orientation"): generator.normal(0, 0.1, (rows, 3)),
        ("imu", "angular_velocity"): generator.normal(0, 1, (rows, 3)),
        ("imu", "linear_acceleration"): generator.normal([0, 0, 9.81], 0.3, (rows, 3)),
        ("policy", "observation"): generator.normal(0, 1, (rows, 4)),
        ("policy", "action"): generator.uniform(-1, 1, (rows, joints)),
        ("policy", "reward"): generator.normal(0, 1, (rows, 1)),
        ("raw", "goal_current"): generator.integers(-855, 856, (rows, joints)).astype(float),
        ("raw", "current"): generator.integers(-855, 856, (rows, joints)).astype(float),
        ("raw", "velocity"): generator.integers(-200, 201, (rows, joints)).astype(float),
        ("raw", "position"): generator.integers(0, 4096, (rows, joints)).astype(float),
        ("raw", "hardware_error"): np.zeros((rows, joints)),
        ("raw", "answered"): generator.integers(0, 2, (rows, joints)).astype(float),
        ("raw", "imu"): generator.integers(-32768, 32768, (rows, 9)).astype(float),
        ("raw", "lateness"): generator.uniform(0, 0.001, (rows, 1)),
        "done": np.arange(rows)[:, None] == rows - 1,
    }
    assert set(values) == set(CHANNELS)
    return values


def rollout(rows: int = 30, seed: int = 0, **changes: Any) -> Rollout:
    """A log with every channel."""
    return Rollout.from_arrays(arrays(rows, seed=seed), metadata(**changes))


def assert_same(a: Rollout, b: Rollout) -> None:
    """Equal metadata and equal bits in every channel."""
    assert a.metadata == b.metadata
    assert a.channels == b.channels
    for key in a.channels:
        assert a.array(key).tobytes() == b.array(key).tobytes(), key
        assert a.data[key].dtype == b.data[key].dtype


def refusal(path: Path) -> str:
    """The sentence with which a log is refused, or nothing where it is read."""
    try:
        read_episodes(path)
    except LogError as error:
        return str(error)
    return ""
