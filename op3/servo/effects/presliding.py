"""Presliding friction: bristles that bend before they slip."""

from math import exp, expm1, sqrt

import numpy as np

from op3.servo.effect import Effect, Parameter, Stage, Usual, register
from op3.servo.law import clip
from op3.servo.machine_code import part

FULLY = 1e9
"""Deflection larger than any bristle's [rad]."""


@part
def deflection(s):
    """Deflection of the bristles at the beginning of a step [rad], from the new velocity."""
    return s.lugre_bent * s.lugre_left + s.lugre_gain * s.velocity


@register
class LuGre(Effect):
    """Presliding: all friction of the joint acts through an elastic bristle (LuGre) instead of rigidly.

    The bound F of all other frictions becomes the torque at which the bristle slips. Its deflection z is integrated
    exactly over a step for the speed predicted from the last step's acceleration, and linearly in the velocity at the
    step's end, which the physics gets as implicit damping. This is stable at 1 ms for any stiffness. With the speed at
    the beginning instead, an accelerating joint would be braked by more than F, as if its rotor were heavier. The
    bristle's own damping acts on the mean rate of its deflection over the step, and so vanishes while the joint slides.
    In the original model viscous friction is parallel to the bristle; here F includes it, and in steady sliding both
    are equal.

    Attributes:
        damping_ratio: damping ratio of the rotor alone on its bristle; without damping a held joint oscillates.
    """

    name = "lugre"
    stage = Stage.TRANSMISSION
    equation = "tau_fric = z / s + sigma_1 dz/dt, dz/dt = w - |w| z / (s F), sigma_1 = 2 zeta sqrt(Ja / s)"
    source = (
        "Canudas de Wit, Olsson, Astrom & Lischinsky (1995), sigma_0 = 1 / s; F from the other effects, including"
        " viscous friction; ranges of s and damping chosen by us"
    )
    parameters = (Parameter("bristle_compliance", "rad/(N m)", 0.0, 0.05, 0.0, 0.0, "s", least=0.0),)
    # our own choice, 1 / (330 N m/rad): friction of 0.1 N m grips within 0.3 mrad, a fifth of an encoder's count
    usual = {"bristle_compliance": Usual(0.003, 0.003, 0.004, 0.05)}
    memory = ("bent", "left", "gain", "velocity")
    constants = ("stiffness", "rate")
    secants = ({"bristle_compliance": 0.005}, {"bristle_compliance": 0.02})
    fingerprint = "a smooth, nearly elastic start of motion over 1 to 3 mrad after each reversal"
    confounders = ("stribeck", "compliance", "backlash")
    separating_experiment = "torque steps below break-away: elastic deflection with hysteresis"

    damping_ratio: float = 0.2

    @staticmethod
    def prepare(p):
        """Torque per deflection, and per deflection gained in a step by damping."""
        soft = p.bristle_compliance > 0.0
        p.lugre_stiffness = 1.0 / p.bristle_compliance if soft else 0.0
        damping = 2.0 * p.lugre_damping_ratio * sqrt(p.armature * p.lugre_stiffness)
        p.lugre_rate = damping / p.timestep

    @staticmethod
    def reset(s, p):
        """Bristles start fully bent in a moving joint, and straight in a joint at rest."""
        # the level of friction bounds it in the first step
        s.lugre_bent, s.lugre_left, s.lugre_gain = FULLY * np.sign(s.velocity), 1.0, 0.0
        s.lugre_velocity = s.velocity

    @staticmethod
    def apply(s, p):
        """Replace the bound by the bristle's torque."""
        if p.bristle_compliance <= 0.0:
            return
        limit = max(s.friction_bound * p.bristle_compliance, 1e-12)
        bent = clip(deflection(s), -limit, limit)
        # a joint that an impact has slowed down may be foretold to rest, and would be gripped by far more than F
        speed = max(abs(2.0 * s.velocity - s.lugre_velocity), 0.5 * abs(s.velocity))
        # share of a deflection that a step leaves, and how much deflection a unit of velocity adds in it
        slip = max(p.timestep * speed / limit, 1e-9)
        s.lugre_bent, s.lugre_left, s.lugre_gain = bent, exp(-slip), p.timestep * -expm1(-slip) / slip
        s.lugre_velocity = s.velocity
        whole = p.lugre_stiffness + p.lugre_rate
        s.applied_torque -= whole * deflection(s) - p.lugre_rate * bent
        s.damping += s.lugre_gain * whole
        s.friction_bound = 0.0

    @staticmethod
    def balance(s, p, torque, rests):
        """Bristles of resting joints take up the torque; the level of friction bounds them in the next step."""
        if p.bristle_compliance <= 0.0:
            return torque
        s.lugre_bent = deflection(s) + (p.bristle_compliance * torque if rests else 0.0)
        s.lugre_left, s.lugre_gain = 1.0, 0.0
        return 0.0
