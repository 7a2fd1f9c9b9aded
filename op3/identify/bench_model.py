"""A model of the servo on a bench, for given models whose servos a computer drives by current."""

from collections.abc import Sequence

from op3.rollout import LogError, Rollout
from op3.servo import RobotModel
from op3.sim import load_model

BENCH_BASES = {"sts3032": "rhoban_m1", "xl330": "xl330_m1"}
"""Models with Coulomb and viscous friction for the servos of known bench recordings."""


def suited(model: RobotModel, logs: Sequence[Rollout]) -> RobotModel:
    """The given model, or a friction-only model of the bench's servo with initial values.

    A PD loop that commands current cannot simulate a servo whose firmware closes the position loop.

    Raises:
        LogError: if there is no model for the servo of the logs.
    """
    first = logs[0]
    own_loop = first.metadata.mount == "pendulum" and "command/firmware_gain" in first
    if not own_loop or "current_pd" not in model.effect_names:
        return model
    servo = first.metadata.servo
    if servo not in BENCH_BASES:
        raise LogError(
            f"the model is driven by current, but the servo {servo!r} of these logs has an internal position loop",
            "give a model of that servo, such as assets/models/xl330_m1.yaml",
            source=first.metadata.recording,
            column="field servo",
        )
    return load_model(BENCH_BASES[servo])
