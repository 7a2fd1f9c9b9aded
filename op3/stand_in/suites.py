"""Robots, scenes and motions of the bench's cases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.motions import (
    Excitation,
    Motion,
    SinusoidalGait,
    leg_suite,
    leg_walking,
    multisine,
    push_down,
    robot_suite,
    robot_walking,
    soften,
    squat,
    sway,
)
from op3.motions.op3_suites import JOINTS_PER_LEG, KNEE, arm_joints, leg_joints
from op3.robot import load_robot
from op3.scenes import build_bench, build_scene
from op3.scenes.scene import Scene
from op3.stand_in.play import FloorExcitation, TrunkPush

Array = NDArray[np.float64]
Suite = Callable[[int], Sequence[Excitation]]


@dataclass(frozen=True)
class Setting:
    """A robot in a scene with its runs.

    Attributes:
        scene: function that builds the scene.
        rich: function of a seed that returns runs which reveal most effects.
        poor: function of a seed that returns runs with which many effects cannot be distinguished.
        settle: time for which the first target of a run is held before the recording starts [s].
        metadata: function that returns further metadata of the logs.
    """

    scene: Callable[[], Scene]
    rich: Suite
    poor: Suite
    settle: float = 0.8
    metadata: Callable[[], dict[str, Any]] = dict


def floor_suite(seed: int) -> list[FloorExcitation]:
    """The whole robot on its feet, 26 runs: squats, weight shifts, compliant knees, arms, steps on the spot, pushes.

    Args:
        seed: seed of depths, speeds, gains and pushes. Equal seeds give equal commands.
    """
    rng = np.random.default_rng([seed, 23])
    draw = rng.uniform

    def run(
        motion: Motion, gain: float | None = None, warm: bool = False, pushes: tuple[TrunkPush, ...] = ()
    ) -> FloorExcitation:
        p_gain = motion.p_gain if gain is None else gain
        own = np.asarray(p_gain, dtype=float)
        return FloorExcitation(motion, own[:, None] if own.ndim else float(own), 0.1, warm=warm, pushes=pushes)  # type: ignore[arg-type]

    def bend(name: str) -> Motion:
        low, high = draw(1.1, 1.45), draw(0.6, 0.9)
        return squat(float(low), float(high), float(draw(0.3, 0.7)), duration=5.0, name=name)

    def knees(name: str) -> Motion:
        depths = (float(draw(0.6, 0.8)), float(draw(1.2, 1.45)), float(draw(0.8, 1.0)))
        return push_down(depths, float(draw(0.9, 1.4)), 0.5, name=name)

    def lean(name: str) -> Motion:
        return sway(float(draw(0.05, 0.09)), float(draw(0.3, 0.6)), 5.0, name=name)

    def arms(name: str) -> Motion:
        return multisine(
            {joint: float(draw(0.15, 0.4)) for joint in arm_joints()}, duration=5.0, name=name, robot="op3"
        )

    def steps(name: str) -> Motion:
        gait = SinusoidalGait(period=float(draw(0.55, 0.7)), step=0.0, foot_height=float(draw(0.02, 0.035)))
        walk = gait.motion(4.0)
        return Motion(walk.time, walk.position, walk.joints, name, robot=walk.robot)

    def pushed() -> tuple[TrunkPush, ...]:
        return tuple(
            TrunkPush(float(start), (float(draw(3, 9) * rng.choice([-1, 1])), float(draw(-4, 4)), 0.0))
            for start in (1.0, 2.2, 3.4)
        )

    first, second = run(bend("repeated_squat")), run(lean("repeated_sway"))
    plan = [first, second, run(knees("push_down_1")), run(steps("steps_1")), run(bend("squat_1"), 4.0), first]
    plan += [run(soften(float(draw(1.0, 1.3)), cycles=1, name="soften_1")), second, run(arms("arms_1"))]
    plan += [run(bend("pushed_squat_1"), pushes=pushed()), run(steps("steps_2")), first, run(lean("sway_1"), 4.0)]
    plan += [run(knees("push_down_2"), 4.5), second, run(bend("squat_2")), run(arms("arms_2")), first]
    plan += [run(lean("pushed_sway_1"), pushes=pushed()), second, run(bend("squat_3"))]
    plan += [run(bend("squat_4"), warm=True), run(knees("push_down_3"), warm=True), run(lean("sway_2"), warm=True)]
    plan += [run(steps("steps_3"), warm=True), run(bend("pushed_squat_2"), warm=True, pushes=pushed())]
    return plan


def floor_walking(seed: int) -> list[Excitation]:
    """Only steps on the spot; every sixth run repeats the first."""
    rng = np.random.default_rng([seed, 24])

    def run(name: str) -> FloorExcitation:
        walk = SinusoidalGait(period=float(rng.uniform(0.55, 0.7)), step=0.0, foot_height=0.03).motion(4.0)
        return FloorExcitation(Motion(walk.time, walk.position, walk.joints, name, robot=walk.robot))

    first = run("repeated_walk")
    return [first if i % 6 == 0 else run(f"walk_{i - i // 6}") for i in range(26)]


def joint_suite(seed: int, robot: str = "bench", poor: bool = False) -> list[Excitation]:
    """A leg's suite for the joints of any robot on its base, around home, scaled up as far as limits allow.

    Args:
        seed: seed of amplitudes, frequencies and phases. Equal seeds give equal commands.
        robot: a name in `assets/robots`, or the path of a robot file.
        poor: whether the joints only move as in walking.
    """
    known = load_robot(robot)
    room = np.minimum(known.home - known.limits[:, 0], known.limits[:, 1] - known.home)
    columns = [(KNEE + number) % JOINTS_PER_LEG for number in range(len(room))]
    runs = []
    for run in (leg_walking if poor else leg_suite)(seed):
        away = run.motion.position[:, columns] - run.motion.position[:, columns].mean(0)
        larger = np.minimum(3.0, 0.9 * room / np.maximum(np.abs(away).max(0), 1e-3))
        position = known.home + larger * away
        motion = Motion(run.motion.time, position, known.joints, run.motion.name, robot=known.reference)
        runs.append(Excitation(motion, run.p_gain, run.d_gain, warm=run.warm))
    return runs


SETTINGS: dict[str, Setting] = {
    "op3": Setting(
        partial(build_scene, "stand", "op3"), partial(robot_suite, duration=6.0), partial(robot_walking, duration=6.0)
    ),
    "floor": Setting(partial(build_scene, "floor", "op3"), floor_suite, floor_walking, 1.5),
    "leg": Setting(lambda: build_scene("stand", "op3", joints=leg_joints()), leg_suite, leg_walking),
    "pendulum": Setting(
        build_bench,
        joint_suite,
        partial(joint_suite, poor=True),
        metadata=lambda: {name: one.default for name, one in load_robot("bench").file.parameters.items()},
    ),
    "arm": Setting(
        partial(build_scene, "stand", "arm"),
        partial(joint_suite, robot="arm"),
        partial(joint_suite, robot="arm", poor=True),
    ),
}
"""The whole OP3 on the stand and on the floor, its right leg alone, one servo with a pendulum, a six-joint arm."""
