"""A model of the servo on a bench, if the given model is of a servo that a computer drives by current."""

from collections.abc import Sequence

from op3.rollout import LogError, Rollout
from op3.servo import RobotModel
from op3.sim import load_model

BENCH_BASES = {"sts3032": "rhoban_m1", "xl330": "xl330_m1"}
"""Models with Coulomb and viscous friction of the servos that the importer of bench recordings knows."""


def suited(model: RobotModel, logs: Sequence[Rollout]) -> RobotModel:
    """The model itself, or a model of the bench's servo with only friction, with initial values.

    A servo that closes the position loop in its firmware cannot be simulated by a PD that commands current.

    Raises:
        LogError: if there is no model of the logs' servo.
    """
    first = logs[0]
    own_loop = first.metadata.mount == "pendulum" and "command/firmware_gain" in first
    if not own_loop or "current_pd" not in model.effect_names:
        return model
    servo = first.metadata.servo
    if servo not in BENCH_BASES:
        raise LogError(
            f"the model is driven by current, but these logs are of a servo {servo!r} with a position loop of its own",
            "give a model of that servo, such as assets/models/xl330_m1.yaml",
            source=first.metadata.recording,
            column="field servo",
        )
    return load_model(BENCH_BASES[servo])
