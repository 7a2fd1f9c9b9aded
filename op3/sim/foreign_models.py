"""Models of other simulators: converts models to MuJoCo and BAM, and parameters of BAM and PACE to models.

BAM is Rhoban's library of servo models (github.com/Rhoban/bam); its JSON has one servo's parameters at the output.
PACE identifies joints in Isaac Lab (github.com/leggedrobotics/pace-sim2real); its runs have `mean_<iteration>.pt`.
mjlab and MuJoCo Playground read the MJCF unchanged.
"""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from op3.robot.model_source import read_model
from op3.robot.robot import Robot
from op3.robot.servo_make import find_servo
from op3.servo import Estimate, RobotModel, effect_class

_DRIVES = ("position_servo", "motor", "coulomb", "viscous")

EXPRESSES: Mapping[str, tuple[str, ...]] = {
    "mjcf": (*_DRIVES, "current_pd"),
    "bam": (
        *(*_DRIVES, "latency", "stribeck", "load_friction"),
        *("directional_friction", "antagonistic_friction", "encoder_offset"),
    ),
}
"""Effects that a format has, by its name."""

_BAM: Mapping[str, Mapping[str, str]] = {
    "motor": {"kt": "torque_constant", "R": "terminal_resistance", "armature": "armature"},
    "coulomb": {"friction_base": "coulomb_friction"},
    "viscous": {"friction_viscous": "viscous_friction"},
    "stribeck": {"friction_stribeck": "static_friction_excess", "dtheta_stribeck": "stribeck_velocity"},
    "load_friction": {"load_friction_base": "load_friction", "load_friction_stribeck": "load_friction_excess"},
    "directional_friction": {
        "load_friction_motor": "motor_friction",
        "load_friction_external": "external_friction",
        "load_friction_motor_stribeck": "motor_friction_excess",
        "load_friction_external_stribeck": "external_friction_excess",
    },
    "antagonistic_friction": {
        "load_friction_motor_quad": "motor_square",
        "load_friction_external_quad": "external_square",
    },
    "latency": {"command_delay": "command_latency"},
    "encoder_offset": {"q_offset": "encoder_offset"},
}
"""BAM's names of parameters, by effect."""

_FADES = {1.0: "exponential", 2.0: "gaussian"}
"""Form of the decay of friction with speed, by BAM's exponent."""


def expressed(model: RobotModel, to: str) -> tuple[RobotModel, tuple[str, ...]]:
    """The part of a model that a format can represent, and the omitted effects.

    Args:
        model: model with any effects.
        to: one of `EXPRESSES`.
    """
    lost = tuple(name for name in model.effect_names if name not in EXPRESSES[to])
    return model.without(*lost), lost


def to_bam(model: RobotModel, servo: str, joint: str) -> dict[str, Any]:
    """BAM's parameters of one joint's servo.

    Args:
        model: model of a servo that closes its position loop itself.
        servo: BAM's name of the servo.
        joint: joint whose values are used if joints differ.

    Raises:
        ValueError: if the servo is current-controlled, for which BAM has no law.
    """
    if "position_servo" not in model.effect_names:
        raise ValueError("to=bam: BAM models servos that close their position loop themselves; use to=mjcf")
    on, values = set(model.effect_names), model.tensors([joint])
    found = {
        theirs: float(values[ours][0, 0])
        for effect, names in _BAM.items()
        if effect in on
        for theirs, ours in names.items()
    }
    found["kt"] *= model.effect("motor").gear_ratio  # type: ignore[attr-defined]
    rungs = {"m6": "antagonistic_friction", "m5": "directional_friction", "m4": "stribeck", "m3": "load_friction"}
    rung = next((rung for rung, effect in rungs.items() if effect in on), "m1")
    found |= {} if rung != "m4" or "load_friction" in on else {"load_friction_base": 0.0, "load_friction_stribeck": 0.0}
    if "stribeck" in on:
        found["alpha"] = next(
            a for a, fade in _FADES.items() if fade == getattr(model.effect("stribeck"), "fade", fade)
        )
    return {**found, "model": rung, "actuator": servo}


def from_bam(content: Mapping[str, Any]) -> RobotModel:
    """A model with BAM's parameters; the gain of the position loop comes from the servo file.

    Raises:
        ValueError: if a parameter is missing or no number, or the servo is unknown.
    """
    actuator = str(content.get("actuator"))
    make = find_servo(actuator)
    if make is None or make.position_law is None:
        raise ValueError(f"actuator {actuator!r} is not a servo of assets/servos with a position loop; correct it")
    law, given = make.position_law, {"command_delay": 0.0, "q_offset": 0.0, **content}
    loop = {"error_gain": law.error_gain.si, "max_duty": law.max_duty.si, "goal_speed": law.goal_speed.si}
    options: dict[str, dict[str, Any]] = {
        "motor": {"gear_ratio": 1.0, "drive": "voltage"},
        "latency": {"signal": "goal"},
    }
    alpha = given.get("alpha", 1.0)
    options["stribeck"] = {"fade": _FADES[min(_FADES, key=lambda one: abs(one - float(alpha)))]}
    effects, values = [effect_class("position_servo")(**loop)], {}
    for effect, names in _BAM.items():
        there = {theirs: ours for theirs, ours in names.items() if theirs in given}
        if len(there) < len(names) and (there or effect in ("motor", "coulomb", "viscous")):
            raise ValueError(f"{next(n for n in names if n not in there)!r} is missing; write BAM's parameters again")
        for theirs, ours in there.items():
            if isinstance(given[theirs], bool) or not isinstance(given[theirs], int | float):
                raise ValueError(f"{theirs!r} is {given[theirs]!r}, not a number")
            values[ours] = float(given[theirs])
        effects += [effect_class(effect)(**options.get(effect, {}))] if there else []
    return RobotModel(tuple(effects), bus_voltage=make.supply.si).with_values(values)


def from_pace(path: Path, base: RobotModel, robot: Robot) -> RobotModel:
    """A robot's model with PACE's results: armature, viscous and Coulomb friction and zeros by joint, and a delay.

    PACE counts the delay in steps of its simulator, which are those of the data in its `config.pt`.

    Args:
        path: `mean_<iteration>.pt`, or a folder, whose latest file is used; `config.pt` must be in the same folder.
        base: model of the robot's servos, which supplies the drive, because PACE's files do not contain it.
        robot: robot with these joints.

    Raises:
        ValueError: if a file is missing or not PACE's, or names other joints than the robot has.
    """
    if path.is_dir():
        iterations = {int(file.stem[5:]): file for file in path.glob("mean_*.pt") if file.stem[5:].isdigit()}
        path = iterations[max(iterations)] if iterations else path / "mean_<iteration>.pt"
    about = path.with_name("config.pt")
    for file in (path, about):
        if not file.is_file():
            raise ValueError(f"{file}: there is no such file; give a folder that PACE wrote")
    mean, run = (torch.load(file, map_location="cpu", weights_only=True) for file in (path, about))
    if not isinstance(run, Mapping) or not {"joint_order", "time"} <= run.keys():
        raise ValueError(f"{about}: `joint_order` or `time` is missing; give a folder that PACE wrote")
    joints, period = list(run["joint_order"]), float(torch.as_tensor(run["time"]).double().diff().median())
    if not isinstance(mean, torch.Tensor) or mean.shape != (4 * len(joints) + 1,) or not mean.isfinite().all():
        raise ValueError(
            f"{path}: must contain {4 * len(joints) + 1} finite numbers, four for each of {len(joints)} joints, and a"
            " delay"
        )
    if unknown := [name for name in joints if name not in robot.joints]:
        raise ValueError(f"{about}: {robot.reference} has no joint {unknown[0]!r}; give `robot=` a file with that name")
    *by_joint, delay = mean.double().tolist()
    armature, viscous, coulomb, bias = np.reshape(by_joint, (4, -1))
    values = {"armature": armature, "viscous_friction": viscous, "coulomb_friction": coulomb}
    values["encoder_offset"] = -bias  # PACE's measured angle is the joint's less its bias
    per_joint = {
        name: Estimate(float(value.mean()), joints=dict(zip(joints, value.tolist(), strict=True)))
        for name, value in values.items()
    }
    drive = (*_DRIVES, "current_pd", "latency")
    model = base.without(*(name for name in base.effect_names if name not in drive))
    per_joint["command_latency"] = Estimate(round(delay) * period)
    return model.with_effect(effect_class("encoder_offset")(), per_joint)


def to_mjcf(model: RobotModel, robot: Robot, p_gain: float | None = None, d_gain: float = 0.0) -> str:
    """The robot's MJCF with armature, friction, damping and a position actuator in each joint with a servo.

    Args:
        model: model of its servos.
        robot: robot whose joints are driven.
        p_gain: P gain of a loop outside the servo [A/rad]; None: the servos close their own loop.
        d_gain: D gain of that loop [A s/rad].

    Raises:
        ValueError: if the servos are current-controlled and no gain is given.
    """
    model, _ = expressed(model, "mjcf")
    values = {name: np.broadcast_to(v[0].numpy(), len(robot.joints)) for name, v in model.tensors(robot.joints).items()}
    constant = values["torque_constant"] * model.effect("motor").gear_ratio  # type: ignore[attr-defined]
    zero = np.zeros(len(robot.joints))
    if "position_servo" in model.effect_names:
        servo: Any = model.effect("position_servo")
        stall = constant * model.bus_voltage / values["terminal_resistance"]
        kp = stall * values["controller_gain"] * servo.error_gain * robot.firmware_gain
        kv, most = stall * values["derivative_gain"], stall * servo.max_duty
        damping = constant**2 / values["terminal_resistance"]
    elif p_gain is None:
        raise ValueError(
            "p_gain is missing: the model's servos are driven by current; give the gain of their position loop [A/rad]"
        )
    else:
        current: Any = model.effect("current_pd")
        kp, kv, most, damping = constant * p_gain, constant * d_gain, constant * current.current_limit, zero
    spec = read_model(robot.model_path, robot.file).spec
    spec.meshdir = str((Path(robot.model_path.parent) / spec.meshdir).resolve())
    for index, name in enumerate(robot.joints):
        joint = spec.joint(name)
        joint.armature = values["armature"][index]
        joint.frictionloss = values.get("coulomb_friction", zero)[index]
        joint.damping = np.zeros_like(joint.damping)
        joint.damping[0] = values.get("viscous_friction", zero)[index] + damping[index]
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp[index], kv=kv[index])
        actuator.forcerange, actuator.forcelimited = (-most[index], most[index]), True
        actuator.ctrlrange, actuator.ctrllimited = robot.limits[index], True
    spec.compile()
    return spec.to_xml()
