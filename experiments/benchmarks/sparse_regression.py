"""Baseline of the hidden-effect bench: sparse regression on inverse dynamics, SINDy with orthogonal matching pursuit.

python experiments/benchmarks/sparse_regression.py <case>/data <base model> <folder for verdict.yaml>

Measured currents are regressed on the joint torques of inverse dynamics, from smoothed measured angles, accelerations
and the friction terms of the base model; one further column, or one per joint, is added for the effect that explains
most of the residual on other runs. Effects are only columns of a regression, without simulation, timing or hidden
states.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from op3.robot.kinematics import rotation_matrix
from op3.robot.register_units import GRAVITY
from op3.rollout import Rollout, read_logs
from op3.scenes import build_scene
from op3.sim import load_model

WINDOW, ORDER = 9, 3
"""Samples and degree of the smoothing polynomial."""

LEAST_GAIN = 0.08
"""Share of the residual on other runs below which nothing is named, chosen on a dozen development cases."""

Array = NDArray[np.float64]


def held_model(joints: tuple[str, ...], last_mass: float = 0.0) -> mujoco.MjModel:
    """Limbs of the robot on the stand, without armature, with additional mass of the last link [kg]."""
    model = build_scene("stand", "op3", joints=joints).compile()
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    model.dof_armature[:] = 0
    model.body_mass[model.nbody - 1] += last_mass
    return model


def inverse_dynamics(model: mujoco.MjModel, log: Rollout, q: Array, v: Array, a: Array) -> Array:
    """Torques [time, joint] that a motion requires."""
    model.opt.gravity[:] = rotation_matrix(*log.metadata.extra["tilt"]).T @ np.array([0.0, 0.0, -GRAVITY])
    data, torque = mujoco.MjData(model), np.empty_like(q)
    for row in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], v[row], a[row]
        mujoco.mj_inverse(model, data)
        torque[row] = data.qfrc_inverse
    return torque


def signals(log: Rollout, model: mujoco.MjModel, loaded: mujoco.MjModel) -> dict[str, Array]:
    """Smoothed motion, current, and the torque from inverse dynamics, each [time, joint]."""
    period = 1 / log.metadata.rate

    def smooth(channel: str, derivative: int = 0) -> Array:
        values = log.array(channel)
        return np.array(savgol_filter(values, WINDOW, ORDER, deriv=derivative, delta=period, axis=0))

    q, v, a = (smooth("joint/position", k) for k in range(3))
    torque = inverse_dynamics(model, log, q, v, a)
    i, target = smooth("joint/current"), log.array("command/position")
    day = (np.datetime64(log.metadata.date) - np.datetime64("2026-01-15T09:00")) / np.timedelta64(1, "s")
    change = np.gradient(log.array("command/p_gain") * (target - q) - log.array("command/d_gain") * v, period, axis=0)
    return {
        "q": q, "v": v, "a": a, "i": i, "torque": torque, "sign": np.tanh(v / 0.05), "du": change,
        "warm": np.full_like(q, 1 - np.exp(-day / 150)), "temperature": log.array("joint/temperature") - 25,
        "load": inverse_dynamics(loaded, log, q, v, a) - torque,
    }  # fmt: skip


BASE: dict[str, Callable[[dict[str, Array]], Array]] = {
    "torque_constant": lambda s: s["torque"],
    "armature": lambda s: s["a"],
    "coulomb": lambda s: s["sign"],
    "viscous": lambda s: s["v"],
    "dte": lambda s: np.minimum(s["torque"] * s["sign"], 0) * s["sign"],
    "stribeck": lambda s: s["sign"] * np.exp(-np.abs(s["v"]) / 0.1),
}
"""Columns of the base model, shared by all joints; dte and stribeck only where the base model has them."""

CANDIDATES: dict[str, tuple[bool, tuple[Callable[[dict[str, Array]], Array], ...]]] = {
    "dte": (False, (BASE["dte"],)),
    "stribeck": (False, (BASE["stribeck"],)),
    "coulomb": (True, (BASE["coulomb"],)),
    "viscous": (True, (BASE["viscous"],)),
    "torque_constant": (True, (BASE["torque_constant"],)),
    "load_friction": (False, (lambda s: np.abs(s["torque"]) * s["sign"],)),
    "asymmetric_friction": (True, (lambda s: np.abs(s["sign"]),)),
    "current_offset": (True, (lambda s: np.ones_like(s["q"]),)),
    "quadratic_drag": (False, (lambda s: s["v"] * np.abs(s["v"]),)),
    "cable_spring": (True, (lambda s: s["q"], lambda s: np.ones_like(s["q"]))),
    "position_friction": (True, (lambda s: np.cos(s["q"]) * s["sign"], lambda s: np.sin(s["q"]) * s["sign"])),
    "encoder_offset": (True, (lambda s: np.cos(s["q"]), lambda s: np.sin(s["q"]))),
    "friction_drift": (False, (lambda s: s["warm"] * s["sign"],)),
    "torque_constant_temperature": (False, (lambda s: s["temperature"] * s["torque"],)),
    "latency": (False, (lambda s: s["du"],)),
    "link_mass": (False, (lambda s: s["load"],)),
    **{
        f"cogging#{n}": (True, (lambda s, n=n: np.sin(n * s["q"]), lambda s, n=n: np.cos(n * s["q"])))
        for n in range(12, 42, 2)
    },
}
"""Whether the effect is in a single joint, and its columns, by name."""


def columns(makers: tuple[Callable[[dict[str, Array]], Array], ...], runs: list[dict[str, Array]], joint: int | None):
    """Columns of a regression [sample, column]; in one joint, zero elsewhere."""
    count = runs[0]["q"].shape[1]
    keep = np.ones(count) if joint is None else np.eye(count)[joint]
    return np.stack([np.concatenate([(make(s) * keep)[5:-5].ravel() for s in runs]) for make in makers], 1)


def diagnose(logs: list[Rollout], lacking: set[str]) -> dict:
    """A verdict by one step of orthogonal matching pursuit; every third run tests the fit to the others."""
    joints = logs[0].metadata.joints
    model, loaded = held_model(joints), held_model(joints, 0.1)
    runs = [signals(log, model, loaded) for log in logs]
    fit = np.concatenate([np.full(s["q"][5:-5].size, number % 3 != 2) for number, s in enumerate(runs)])
    target = np.concatenate([s["i"][5:-5].ravel() for s in runs])
    base = np.hstack([columns((make,), runs, None) for name, make in BASE.items() if name not in lacking])

    def left(matrix: Array) -> float:
        solution = np.linalg.lstsq(matrix[fit], target[fit], rcond=None)[0]
        return float(((target - matrix @ solution)[~fit] ** 2).mean())

    before = left(base)
    ranking = []
    for name, (local, makers) in CANDIDATES.items():
        if name in BASE and not local and name not in lacking:
            continue
        for joint in range(len(joints)) if local else [None]:
            gain = 1 - left(np.hstack([base, columns(makers, runs, joint)])) / before
            where = [joints[-1]] if name == "link_mass" else [] if joint is None else [joints[joint]]
            ranking.append({"effect": name.split("#")[0], "joints": where, "gain": gain, "probability": 0.5})
    best = max(ranking, key=lambda entry: entry["gain"])
    return {"findings": [best] if best["gain"] >= LEAST_GAIN else []}


def main(data: str, base: str, run: str) -> None:
    """Read the logs and write the verdict."""
    lacking, logs = {"dte", "stribeck"} - set(load_model(base).effect_names), read_logs(data)
    held = logs[0].metadata.mount == "stand"  # inverse dynamics knows no contact, and this script no other robot
    verdict = diagnose(logs, lacking) if held else {"findings": []}
    (Path(run) / "verdict.yaml").write_text(yaml.safe_dump(verdict, sort_keys=False), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
