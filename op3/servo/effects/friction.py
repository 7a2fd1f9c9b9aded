"""Friction of the joint: the three terms of paper eq. (4) and bearing friction, each a separate effect.

Each adds to one bound, ``tau_fric = fc + s (fs - fc) + kv |w|``, which MuJoCo receives as ``dof_frictionloss``
in every step: a friction that can hold the joint still and always opposes its motion.
"""

from math import inf
from typing import Literal

import numpy as np

from op3.servo.effect import Effect, Parameter, Stage, register
from op3.servo.law import clip, stribeck_fade


@register
class Coulomb(Effect):
    """Friction that is the same at every speed."""

    name = "coulomb"
    stage = Stage.FRICTION
    equation = "tau_fric += fc"
    source = "paper eq. (4); range from Table I"
    parameters = (Parameter("coulomb_friction", "N m", 0.01, 0.25, 0.1, 0.0, "fc", least=0.0),)
    # no maker of hobby servos states their spread; chosen by us, no finer than four fits of one XL330 to
    # more and fewer of its runs, which differ by 17 % (`friction_base` of m1 on four branches of github.com/Rhoban/bam)
    spread = {"coulomb_friction": 0.15}
    secants = ({"coulomb_friction": 0.02},)
    fingerprint = (
        "odd in velocity, the same at every speed and load; a hysteresis loop of constant width 2 fc in "
        "torque over angle"
    )
    confounders = ("asymmetric_friction", "current_offset", "dte")
    separating_experiment = "slow triangles in both directions at two loads"

    @staticmethod
    def apply(s, p):
        s.friction_bound += p.coulomb_friction


@register
class Stribeck(Effect):
    """Friction that is higher near rest and decays with speed.

    Attributes:
        fade: form of the decay: ``exponential`` as in the paper, ``gaussian``, or ``lorentz``.
    """

    name = "stribeck"
    written = {"fade": ("exponential", "gaussian", "lorentz")}
    stage = Stage.FRICTION
    equation = "tau_fric += (fs - fc) exp(-|w| / w_static)"
    source = (
        "paper eq. (4) with corrected exponential; range of fs - fc from Table I, of w_static chosen by us; decays:"
        " Armstrong-Helouvry, Dupont & Canudas de Wit (1994)"
    )
    parameters = (
        Parameter("static_friction_excess", "N m", 0.0, 0.25, 0.05, 0.0, "fs - fc", least=0.0),
        Parameter(
            "stribeck_velocity", "rad/s", 0.02, 3.0, 0.1, None, "w_static, not in the paper", least=1e-4, searched=False
        ),
    )
    # no maker of hobby servos states their spread; chosen by us, no finer than four fits of one XL330 to
    # more and fewer of its runs, which differ by 17 % (`friction_base` of m1 on four branches of github.com/Rhoban/bam)
    spread = {"static_friction_excess": 0.15}
    secants = (
        {"static_friction_excess": 0.03, "stribeck_velocity": 0.05},
        {"static_friction_excess": 0.03, "stribeck_velocity": 0.15},
        {"static_friction_excess": 0.03, "stribeck_velocity": 0.5},
        {"static_friction_excess": 0.03, "stribeck_velocity": 1.5},
    )
    fingerprint = "odd in velocity and only below w_static; stick-slip and limit cycles near rest"
    confounders = ("viscous", "lugre", "backlash", "load_friction")
    separating_experiment = "slow sweeps at 0.02, 0.05, 0.1 and 0.2 rad/s at two loads"

    fade: Literal["exponential", "gaussian", "lorentz"] = "exponential"

    @staticmethod
    def apply(s, p):
        """Raise the bound near rest, and set the decay for other frictions at this speed."""
        s.fade = stribeck_fade(s.speed, p.stribeck_velocity, p.stribeck_fade)
        s.friction_bound += p.static_friction_excess * s.fade


@register
class Viscous(Effect):
    """Friction proportional to speed, as a further term of the bound."""

    name = "viscous"
    stage = Stage.FRICTION
    equation = "tau_fric += kv |w|"
    source = "paper eq. (4); range from Table I"
    parameters = (Parameter("viscous_friction", "N m s/rad", 0.0025, 0.15, 0.03, 0.0, "kv", least=0.0),)
    # no maker of hobby servos states their spread; chosen by us, no finer than four fits of one XL330 to
    # more and fewer of its runs, which differ by 17 % (`friction_base` of m1 on four branches of github.com/Rhoban/bam)
    spread = {"viscous_friction": 0.15}
    secants = ({"viscous_friction": 0.01},)
    fingerprint = "odd in velocity and proportional to it"
    confounders = ("quadratic_drag", "bearing_friction", "terminal_resistance", "torque_constant")
    separating_experiment = "motion at three speeds, one of them high, and at two temperatures"

    @staticmethod
    def apply(s, p):
        s.friction_bound += p.viscous_friction * s.speed


@register
class BearingFriction(Effect):
    """Viscous friction of the output's bearing, in proportion to the radial force that the shaft carries."""

    name = "bearing_friction"
    stage = Stage.FRICTION
    equation = "tau_fric += kb F_r |w|"
    source = "our own: on Rhoban's servo bench, damping grows with the weight; the range contains the fits"
    parameters = (Parameter("bearing_friction", "m s/rad", 0.0, 0.001, 0.0001, 0.0, "kb, per radial force", least=0.0),)
    reads = ("radial_force",)
    secants = ({"bearing_friction": 5e-5},)
    fingerprint = "odd in velocity, proportional to speed and to the carried weight"
    confounders = ("viscous", "quadratic_drag", "load_friction")
    separating_experiment = "motion at one speed with two loads"

    @staticmethod
    def apply(s, p):
        s.friction_bound += p.bearing_friction * s.radial_force * s.speed


@register
class AsymmetricFriction(Effect):
    """Coulomb friction that is higher in one direction of motion and lower by the same amount in the other.

    The mean of both directions is the friction of the other effects; the bound is zero if half the difference exceeds
    this mean. At rest, the direction is that of the combined torque of motor and load.

    Attributes:
        rest: speed below which a joint counts as resting [rad/s].
    """

    name = "asymmetric_friction"
    stage = Stage.FRICTION
    rank = 2  # the other frictions must be known first, because the bound cannot be negative
    equation = "tau_fric += sign(w) a / 2, not below 0"
    source = "skewed teeth, worms and preloaded seals; range chosen by us, similar to that of Coulomb friction"
    parameters = (
        Parameter("asymmetric_friction", "N m", -0.15, 0.15, 0.0, 0.0, "a, friction for w > 0 minus that for w < 0"),
    )
    secants = ({"asymmetric_friction": 0.03}, {"asymmetric_friction": -0.03})
    fingerprint = "even in velocity and constant, like a current offset but only in motion"
    confounders = ("current_offset", "coulomb", "link_com")
    separating_experiment = "slow triangles in both directions at two orientations of the base; torque at rest"

    rest: float = 0.001

    @staticmethod
    def apply(s, p):
        pushed = s.motor_torque + s.load_torque
        direction = np.sign(s.velocity if s.speed > p.asymmetric_friction_rest else pushed)
        s.friction_bound = clip(s.friction_bound + 0.5 * direction * p.asymmetric_friction, 0.0, inf)


@register
class QuadraticDrag(Effect):
    """Friction that grows with the square of speed: churned grease, air."""

    name = "quadratic_drag"
    stage = Stage.FRICTION
    equation = "tau_fric += c w^2"
    source = "churning loss of a gear box; range chosen by us: at 3 rad/s up to that of Coulomb friction"
    parameters = (Parameter("quadratic_drag", "N m s^2/rad^2", 0.0, 0.03, 0.0, 0.0, "c", least=0.0),)
    secants = ({"quadratic_drag": 0.005},)
    fingerprint = "odd in velocity and growing faster than linearly"
    confounders = ("viscous", "stribeck", "bearing_friction")
    separating_experiment = "motion at three speeds, one of them high"

    @staticmethod
    def apply(s, p):
        s.friction_bound += p.quadratic_drag * (s.speed * s.speed)
