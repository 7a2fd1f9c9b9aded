"""An initial model for any robot: values from its servo files, and guesses for missing values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from op3.robot import Robot, ServoMake
from op3.servo import Effect, Estimate, RobotModel, effect_class
from op3.sim.model_file import load_model

LATENCY = 0.006
"""Initial latency from sensors to torque [s]; the paper gives none."""

COULOMB, STATIC_EXCESS, VISCOUS = 0.03, 0.02, 0.03
"""Initial friction as shares of the stall torque (viscous friction at the no-load speed)."""

EFFICIENCY = 0.8
"""Initial backward efficiency of the gear; middle of the paper's range."""


def servo_model(robot: Robot) -> RobotModel:
    """Drive, gear and friction of a robot's servos, with separate values for joints of different makes."""
    makes = robot.servos
    first = makes[0]
    late = {"signal": "goal"} if first.loop == "firmware" else {}
    effects = [*_drive(first), effect_class("latency")(**late), *map(_effect, ("coulomb", "stribeck", "viscous"))]  # type: ignore[call-arg]
    effects.append(effect_class("dte")(form="passive"))  # type: ignore[call-arg]
    if robot.file.base is not None and not robot.file.fixed:
        effects += [_effect("payload"), _effect("com_offset")]
    values: dict[str, float | Estimate] = {"command_latency": LATENCY, "backward_efficiency": EFFICIENCY}
    for parameter, per_make in _constants(first).items():
        values[parameter] = _estimate([per_make(make) for make in makes], robot.joints)
    if first.loop == "firmware":
        gains = [_law(make).error_gain.si / _law(first).error_gain.si for make in makes]
        values["controller_gain"] = _estimate(gains, robot.joints)
    return RobotModel(tuple(effects), bus_voltage=first.supply.si).with_values(values)


def model_for(robot: Robot, name: str | Path | None = None) -> RobotModel:
    """The model with this name, file or PACE run; otherwise the robot file's or one from its servo files."""
    chosen = name or robot.file.law
    if chosen and (Path(chosen).suffix == ".pt" or (Path(chosen) / "config.pt").is_file()):
        from op3.sim.foreign_models import from_pace  # not read by all who simulate

        return from_pace(Path(chosen), servo_model(robot), robot)
    return load_model(chosen) if chosen else servo_model(robot)


def _effect(name: str) -> Effect:
    return effect_class(name)()


def _law(make: ServoMake):
    assert make.position_law is not None  # otherwise its file is invalid
    return make.position_law


def _drive(make: ServoMake) -> list[Effect]:
    motor = {"gear_ratio": make.motor.gear_ratio.si}
    if make.loop == "firmware":
        law = _law(make)
        options = {"error_gain": law.error_gain.si, "max_duty": law.max_duty.si, "goal_speed": law.goal_speed.si}
        return [effect_class("position_servo")(**options), effect_class("motor")(drive="voltage", **motor)]  # type: ignore[call-arg]
    limit = make.limits.current.si if make.limits.current else make.supply.si / make.motor.terminal_resistance.si
    return [effect_class("current_pd")(current_limit=limit), effect_class("motor")(**motor)]  # type: ignore[call-arg]


def _constants(first: ServoMake):
    """Motor and friction parameters as functions of a make; the gear ratio is from the first make."""
    ratio = first.motor.gear_ratio.si
    return {
        "torque_constant": lambda make: make.output_constant / ratio,
        "terminal_resistance": lambda make: make.motor.terminal_resistance.si,
        "armature": lambda make: make.motor.armature.si,
        "coulomb_friction": lambda make: COULOMB * make.limits.stall_torque.si,
        "static_friction_excess": lambda make: STATIC_EXCESS * make.limits.stall_torque.si,
        "viscous_friction": lambda make: VISCOUS * make.limits.stall_torque.si / make.limits.no_load_speed.si,
    }


def _estimate(values: Sequence[float], joints: Sequence[str]) -> Estimate:
    own = {joint: value for joint, value in zip(joints, values, strict=True) if value != values[0]}
    return Estimate(values[0], joints=own)
