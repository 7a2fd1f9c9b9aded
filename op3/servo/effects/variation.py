"""Differences of servo parameters between sides, and changes with time."""

from collections.abc import Mapping
from math import expm1

from torch import Tensor

from op3.servo.effect import Effect, Parameter, Stage, register
from op3.servo.effects.electrical import scaled

FRICTION = ("coulomb_friction", "viscous_friction", "static_friction_excess")
"""Parameters that the left-right asymmetry of friction scales."""


@register
class FrictionDrift(Effect):
    """Load-independent friction decreases towards a share of its initial value while the grease warms up."""

    name = "friction_drift"
    stage = Stage.FRICTION
    rank = 1
    equation = "tau_fric -= c (1 - exp(-t / T)) (fc + kv |w|)"
    source = (
        "friction of robot joints falls with temperature (Bittencourt, Wernholt et al. 2010); the dependence on"
        " time instead, and the ranges, are our own"
    )
    parameters = (
        Parameter("friction_drift", "-", -0.6, 0.6, 0.0, 0.0, "c, share of friction lost when warm", most=1.0),
        Parameter("friction_drift_time", "s", 30.0, 600.0, 180.0, None, "T", least=1e-3),
    )
    reads = ("time",)
    secants = (
        {"friction_drift": 0.2, "friction_drift_time": 60.0},
        {"friction_drift": 0.2, "friction_drift_time": 300.0},
    )
    fingerprint = "odd in velocity, changing slowly within and across runs with time since the start"
    confounders = ("torque_constant_temperature", "coulomb", "viscous")
    separating_experiment = "the same slow triangle when cold, after 5 minutes and after 15 minutes"
    scopes = ("joint", "shared")

    @staticmethod
    def apply(s, p):
        """Lower the bound by the decrease so far."""
        gone = p.friction_drift * -expm1(-s.time / p.friction_drift_time)
        s.friction_bound -= gone * p.coulomb_friction
        s.friction_bound -= gone * p.viscous_friction * s.speed


@register
class LeftRightAsymmetry(Effect):
    """The servos of one side differ from those of the other: friction and torque, each by its antisymmetric part.

    Joints whose names begin with ``l_`` have ``1 + a`` of the parameter, those with ``r_`` have ``1 - a``. Friction is
    that of `coulomb`, `viscous` and `stribeck`, torque the torque constant.
    """

    name = "left_right_asymmetry"
    both_sides = True
    stage = Stage.FRICTION
    equation = "fc, kv, fs - fc *= 1 +- a; Kt *= 1 +- b; + left, - right"
    source = "unit-to-unit spread and wear; ranges chosen by us"
    parameters = (
        Parameter("friction_asymmetry", "-", -0.4, 0.4, 0.0, 0.0, "a", per_joint=False, least=-1.0, most=1.0),
        Parameter("torque_asymmetry", "-", -0.2, 0.2, 0.0, 0.0, "b", per_joint=False, least=-0.9, most=0.9),
    )
    secants = ({"friction_asymmetry": 0.15}, {"torque_asymmetry": 0.05})
    fingerprint = "mirrored motions leave different residuals whose sum is zero"
    confounders = ("imu_mount", "ground_tilt", "coulomb", "torque_constant")
    separating_experiment = "mirrored motions, before and after turning the robot by 180 degrees on the spot"

    def adjust(self, values: Mapping[str, Tensor], sides: Tensor) -> Mapping[str, Tensor]:
        sides = sides.to(values["friction_asymmetry"])  # the precision is that of the parameters
        for name in FRICTION:
            values = scaled(values, name, values["friction_asymmetry"] * sides)
        return scaled(values, "torque_constant", values["torque_asymmetry"] * sides)
