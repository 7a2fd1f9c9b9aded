"""A model of the servo on a bench, where the given one is of a servo that a computer drives by current."""

from collections.abc import Sequence

from op3.rollout import LogError, Rollout
from op3.servo import RobotModel
from op3.sim import load_model
from op3.sim.pendulum_simulation import LINK, ROTOR

BENCH_BASES = {"sts3032": "rhoban_m1", "xl330": "xl330_m1"}
"""Models with Coulomb and viscous friction of the servos that the importer of bench recordings knows."""

DRIVE = ("current_pd", "latency", "motor")
"""Effects of a current drive, in whose place the servo's own position loop and voltage drive stand."""


def suited(model: RobotModel, logs: Sequence[Rollout]) -> RobotModel:
    """The model itself, or its effects on a model of the bench's servo.

    A servo that closes the position loop in its firmware cannot be simulated by a PD that commands current. Of a model
    of the latter the friction is kept, on the motor and controller of a model of the servo; the values are a start.

    Args:
        model: that was given.
        logs: to be diagnosed.

    Raises:
        LogError: if the logs name a servo of which there is no model.
    """
    first = logs[0]
    if (
        first.metadata.mount != "pendulum"
        or "command/firmware_gain" not in first
        or "current_pd" not in model.effect_names
    ):
        return model
    servo = first.metadata.servo
    if servo not in BENCH_BASES:
        raise LogError(
            f"the model is driven by current, but these logs are of a servo {servo!r} with a position loop of its own",
            "give a model of that servo, such as conf/servo/xl330_m1.yaml",
            source=first.metadata.recording,
            column="field servo",
        )
    base = load_model(BENCH_BASES[servo])
    smaller = base.value("coulomb_friction") / model.value("coulomb_friction") if _has(model, "coulomb") else 1.0
    for effect in model.effects:
        elsewhere = any(edit not in (ROTOR, LINK) for edit in effect.edits)
        if effect.name in (*DRIVE, *base.effect_names) or elsewhere:
            continue
        values = {p.name: model.value(p.name) * (smaller if p.unit == "N m" else 1.0) for p in effect.parameters}
        base = base.with_effect(effect, values)
    return base


def _has(model: RobotModel, name: str) -> bool:
    return name in model.effect_names
