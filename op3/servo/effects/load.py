"""Friction that grows with load: the terms of the published ladder of friction models M3 to M6, each an effect.

The ladder is that of Duclusaud et al., "Extended Friction Models for the Physics Simulation of Servo Actuators" (ICRA
2025, arXiv 2410.08650): M1 is `coulomb` and `viscous`, M2 adds `stribeck` to it, M3 `load_friction` without excess; M4
has both, and the excess; M5 has `directional_friction` in place of `load_friction`, and M6 adds
`antagonistic_friction`. There the load is gravity's torque; here it is what the output transmits to its link, as for
every effect. There friction near rest decays as ``exp(-|w / w_static|^alpha)`` with an alpha that is fitted (0.8 to 3
on their servos up to M4); here as in the effect `stribeck`, with an alpha of 1 or 2.

Shares are searched up to 0.5 there (1 for the excess, 0.01 / (N m) for the squares, where fits of M6 often end); the
wider ranges here are chosen by us.
"""

from typing import Literal

from op3.servo.effect import Effect, Parameter, Stage, register
from op3.servo.law import antagonistic_friction, load_friction

SUM = 0
"""Index of that form in its list."""

SOURCE = "Duclusaud et al. (2025), Extended Friction Models for the Physics Simulation of Servo Actuators"


@register
class LoadFriction(Effect):
    """Friction proportional to the torque that the gear transmits between motor and load.

    Attributes:
        form: ``sum``: in proportion to what motor and load press together, as published. ``motor``: to the motor's
            torque alone, as M5 with ``le = 0``, which its fits of MX-64 and XL330 nearly have (that of the XL-320 has
            only the load's): most is lost in the first stages, which the load reaches through all others. The factor is
            two, so that a share means the same in both forms to first order: in slow motion both torques are equal
            except for the loss. With a share of one half a motor cannot move this gear.
    """

    name = "load_friction"
    written = {"form": ("sum", "motor")}
    stage = Stage.LOAD
    equation = (
        "tau_fric += (l + s ls) |tau_m - tau_a|, s = exp(-|w| / w_static); form `motor`: 2 |tau_m| instead of the"
        " difference"
    )
    source = f"{SOURCE}, models M3 and M4"
    parameters = (
        Parameter("load_friction", "-", 0.0, 0.9, 0.1, 0.0, "friction per transmitted torque, l", least=0.0),
        Parameter("load_friction_excess", "-", 0.0, 1.0, 0.0, 0.0, "additional friction near rest, ls", least=0.0),
    )
    secants = ({"load_friction": 0.05}, {"load_friction": 0.2})
    fingerprint = "odd in velocity; the width of the hysteresis loop grows in proportion to the load"
    confounders = ("dte", "directional_friction", "antagonistic_friction", "torque_constant")
    separating_experiment = (
        "hold test with two loads: the torque constant moves the centre of the hysteresis loop, friction changes its"
        " width"
    )

    form: Literal["sum", "motor"] = "sum"

    @staticmethod
    def apply(s, p):
        share = p.load_friction + s.fade * p.load_friction_excess
        if p.load_friction_form == SUM:
            s.friction_bound += load_friction(s.motor_torque, s.load_torque, share, share)
        else:
            s.friction_bound += load_friction(s.motor_torque, s.load_torque, 2.0 * share, 0.0)


@register
class DirectionalFriction(Effect):
    """Friction with different shares of the motor's torque and of the load's torque."""

    name = "directional_friction"
    stage = Stage.LOAD
    equation = "tau_fric += |lm tau_m - le tau_a| + s |lms tau_m - les tau_a|, s = exp(-|w| / w_static)"
    source = f"{SOURCE}, model M5"
    parameters = (
        Parameter("motor_friction", "-", 0.0, 0.9, 0.1, 0.0, "share of the motor's torque, lm", least=0.0),
        Parameter("external_friction", "-", 0.0, 0.9, 0.1, 0.0, "share of the load's torque, le", least=0.0),
        Parameter("motor_friction_excess", "-", 0.0, 1.0, 0.0, 0.0, "motor's share near rest, lms", least=0.0),
        Parameter("external_friction_excess", "-", 0.0, 1.0, 0.0, 0.0, "load's share near rest, les", least=0.0),
    )
    # a share of the motor's torque alone is `load_friction` of the form `motor`
    secants = ({"external_friction": 0.1},)
    fingerprint = "odd in velocity; the width of the hysteresis loop depends on whether the motor or the load drives"
    confounders = ("dte", "load_friction", "antagonistic_friction")
    separating_experiment = "hold test with two loads, raised and lowered; motion with the torque off"

    @staticmethod
    def apply(s, p):
        motor, load = s.motor_torque, s.load_torque
        steady = load_friction(motor, load, p.motor_friction, p.external_friction)
        excess = load_friction(motor, load, p.motor_friction_excess, p.external_friction_excess)
        s.friction_bound += steady + s.fade * excess


@register
class AntagonisticFriction(Effect):
    """Friction near rest that grows with the square of the weaker torque where motor and load oppose each other."""

    name = "antagonistic_friction"
    stage = Stage.LOAD
    equation = (
        "where tau_m tau_a < 0: tau_fric += s qe tau_a^2 if |tau_m| > |tau_a|, else s qm tau_m^2;"
        " s = exp(-|w| / w_static)"
    )
    source = f"{SOURCE}, model M6"
    parameters = (
        Parameter("motor_square", "1/(N m)", 0.0, 5.0, 0.0, 0.0, "qm, if the load's torque is larger", least=0.0),
        Parameter("external_square", "1/(N m)", 0.0, 5.0, 0.0, 0.0, "qe, if the motor's torque is larger", least=0.0),
    )
    secants = ({"external_square": 0.2}, {"motor_square": 0.2})
    fingerprint = "only near rest; grows with the square of the weaker torque where motor and load oppose each other"
    confounders = ("dte", "load_friction", "directional_friction", "stribeck")
    separating_experiment = "hold test with three loads: the width of the hysteresis is not linear in the load"

    @staticmethod
    def apply(s, p):
        bound = antagonistic_friction(s.motor_torque, s.load_torque, p.motor_square, p.external_square)
        s.friction_bound += s.fade * bound
