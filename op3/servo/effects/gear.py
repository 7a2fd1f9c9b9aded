"""Losses of the gear train that depend on load."""

from math import exp
from typing import Literal

import numpy as np

from op3.servo.effect import Effect, Parameter, Stage, Usual, register
from op3.servo.effects.presliding import deflection
from op3.servo.law import dte_brake, dte_passive_loss, dte_power_loss, motor_leads, zones

PASSIVE, POWER = 0, 2
"""Indices of the forms in their list."""


@register
class DirectionalEfficiency(Effect):
    """Directional transmission efficiency (DTE): a gear has larger losses when it is driven from its output.

    The default is the passive form: it has the same loss as the printed rule while the joint moves, holds the same
    range of loads at rest, and never adds energy. The form ``power`` depends on the direction of motion.

    Attributes:
        form: ``passive``, a friction bound by the torques, our own; ``power``, one by the direction of motion, as
            Pelchen, Schweiger & Otter (2002); or ``printed``, the brake torque of paper eq. (3).
    """

    name = "dte"
    written = {"form": ("passive", "power")}
    stage = Stage.GEAR
    equation = "tau_loss = (1 - eta_fw) |tau_m| if the motor drives, (1 - eta_bw) |tau_a| if the load drives"
    source = (
        "paper eq. (3) with corrected second condition; ranges from Table I;"
        " form `power`: Pelchen, Schweiger & Otter (2002)"
    )
    parameters = (
        Parameter(
            "forward_efficiency", "-", 0.6, 1.0, 1.0, 1.0, "eta_fw, motor drives", least=0.0, most=1.0, searched=False
        ),
        Parameter("backward_efficiency", "-", 0.6, 1.0, 0.8, 1.0, "eta_bw, load drives", least=0.0, most=1.0),
    )
    secants = ({"backward_efficiency": -0.05}, {"backward_efficiency": -0.2})
    fingerprint = "proportional to the load where the load drives (lowering, landing), zero where the motor drives"
    confounders = ("load_friction", "directional_friction", "antagonistic_friction", "torque_constant", "payload")
    separating_experiment = (
        "hold test with two loads, slowly raised and lowered: with load friction, the hysteresis of the current "
        "grows with the load"
    )

    form: Literal["passive", "printed", "power"] = "passive"

    @staticmethod
    def apply(s, p):
        """Apply the loss, as friction or as a brake."""
        motor, load = s.motor_torque, s.load_torque
        forward, backward = p.forward_efficiency, p.backward_efficiency
        if p.dte_form == PASSIVE:
            s.friction_bound += dte_passive_loss(motor, load, forward, backward)
            if motor_leads(motor, load):
                # the loss decreases with the motor torque as the joint accelerates, so less of the motor's damping is
                # transmitted
                s.damping *= 1.0 - (1.0 - forward) * np.sign(motor * s.velocity)
        elif p.dte_form == POWER:
            # presliding bristles give the direction in which the teeth are strained before the joint moves
            direction = deflection(s) if p.bristle_compliance > 0.0 else s.velocity
            s.friction_bound += dte_power_loss(motor, load, direction, forward, backward)
        else:
            s.applied_torque += dte_brake(motor, load, forward, backward)
            drives, driven = zones(motor, load, forward, backward)
            s.damping *= forward if drives else (1.0 if driven else 0.0)


@register
class MixedLubrication(Effect):
    """Larger friction of slowly sliding teeth: the loss of `dte` is larger near rest than at speed.

    The coefficient of friction of a mesh decreases from boundary to mixed lubrication with speed. The exponential decay
    of the loss of `dte` is our own: one of the sources tabulates efficiency over speed, the other lets the sum of both
    torques decay, with a further exponent. Static friction without load decays as in the effect `stribeck`.
    """

    name = "mixed_lubrication"
    stage = Stage.GEAR
    rank = 1  # after the loss has been computed
    equation = "tau_loss *= 1 + b exp(-|w| / w_b)"
    source = (
        "Pelchen, Schweiger & Otter (2002), mesh efficiency over speed; Duclusaud et al. (2025), model M4,"
        " whose velocities are searched from 0.1 to 3 rad/s"
    )
    parameters = (
        Parameter("near_rest_loss", "-", 0.0, 1.0, 0.0, 0.0, "b, additional loss near rest", least=0.0),
        Parameter("lubrication_velocity", "rad/s", 0.03, 3.0, 0.5, None, "w_b", least=0.03, most=3.0, searched=False),
    )
    # a mesh's efficiency depends on speed, as a table (Pelchen, Schweiger & Otter 2002). The fade is that of M4 of
    # Duclusaud et al. (2025), whose fits fade over 0.35 to 2.6 rad/s. How much more is lost near rest is our own
    # choice: there 1.1 times as much on the XL330, nothing on XL-320 and eRob80:50, nearly all on MX-64 and MX-106
    usual = {
        "near_rest_loss": Usual(0.0, 1.0, 0.4, 3.0),
        "lubrication_velocity": Usual(0.5, 1.0, 0.5, 3.0, least=0.03),
    }
    fingerprint = "only at low speed: odd in velocity and, where the load drives, proportional to the load"
    confounders = ("dte", "load_friction", "stribeck")
    separating_experiment = "slow sweeps at 0.02, 0.05, 0.1 and 0.5 rad/s at two loads"

    @staticmethod
    def apply(s, p):
        s.friction_bound *= 1.0 + p.near_rest_loss * exp(-s.speed / p.lubrication_velocity)
