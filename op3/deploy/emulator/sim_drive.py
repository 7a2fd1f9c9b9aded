"""The part of the servo law that the emulated bus and firmware stand in for."""

from dataclasses import replace

from op3.servo import RobotModel, Stage
from op3.servo.effects import Motor

UNBOUNDED = 1e3
"""Stands for a current without bound [A]."""

BUS_EFFECTS = ("latency", "packet_drop")
"""Effects that the emulated bus has by itself."""


def behind_bus(model: RobotModel) -> RobotModel:
    """A model as it stands behind the bus: without a PD and delays of its own, its motor driven by the registers.

    Raises:
        ValueError: if the model's motor does not regulate current.
    """
    motor = model.effect("motor")
    if not isinstance(motor, Motor) or motor.drive != "current":
        raise ValueError(
            "the emulated servos regulate current, but this model's motor applies a voltage; give a model of the OP3's"
            " servos, with `motor: {drive: current}`"
        )
    gone = [e.name for e in model.effects if e.stage in (Stage.COMMAND, Stage.CONTROLLER) or e.name in BUS_EFFECTS]
    return model.without(*gone).with_effect(replace(motor, drive="registers"))  # pyright: ignore[reportArgumentType]
