"""Torque and friction that depend on the joint's angle."""

from math import cos, pi, sin

from op3.servo.effect import Effect, Parameter, Stage, register


@register
class Cogging(Effect):
    """Torque ripple of meshing teeth, periodic in the joint's angle."""

    name = "cogging"
    stage = Stage.GEAR
    equation = "tau += A sin(n q + phi)"
    source = "mesh of the last stages with n teeth; ranges chosen by us; the rotor's cogging is too fast for a log"
    parameters = (
        Parameter("cogging_amplitude", "N m", -0.05, 0.05, 0.0, 0.0, "A, at the joint"),
        Parameter("cogging_phase", "rad", -pi, pi, 0.0, None, "phi"),
        Parameter("cogging_periods", "-", 6.0, 60.0, 24.0, None, "n, ripples per turn of the joint", least=0.0),
    )
    secants = tuple(
        {"cogging_amplitude": 0.01, "cogging_phase": phase, "cogging_periods": periods}
        for periods in (12.0, 24.0, 36.0, 48.0)
        for phase in (0.0, pi / 2)
    )
    fingerprint = "a narrow line in the spectrum over position; over time, its frequency is proportional to the speed"
    confounders = ("position_friction", "encoder_nonlinearity", "stribeck")
    separating_experiment = "slow sweeps at two speeds: a ripple stays at the same angles"
    scopes = ("joint",)

    @staticmethod
    def apply(s, p):
        s.applied_torque += p.cogging_amplitude * sin(p.cogging_periods * s.position + p.cogging_phase)


@register
class CableSpring(Effect):
    """A cable across the joint acts like a spring in parallel with the servo: the gear does not carry its torque."""

    name = "cable_spring"
    stage = Stage.PARALLEL
    equation = "tau -= k (q - q0)"
    source = "cable harness across a joint; range chosen by us"
    parameters = (
        Parameter("cable_stiffness", "N m/rad", 0.0, 0.3, 0.0, 0.0, "k", least=0.0),
        Parameter("cable_rest_angle", "rad", -1.5, 1.5, 0.0, None, "q0", mirrored=True),
    )
    memory = ("pull",)
    secants = tuple({"cable_stiffness": 0.05, "cable_rest_angle": angle} for angle in (-1.0, 0.0, 1.0))
    fingerprint = "a function of the angle, the same in both directions and at all orientations of the robot"
    confounders = ("link_com", "com_offset", "encoder_offset", "current_offset")
    separating_experiment = "orientations of the base 90 degrees apart: gravity turns with it, a spring does not"
    scopes = ("joint", "side")

    @staticmethod
    def begin(s, p):
        """Subtract the cable's torque from the load of the gear."""
        s.cable_spring_pull = p.cable_stiffness * (p.cable_rest_angle - s.link_position)
        s.load_torque += s.cable_spring_pull

    @staticmethod
    def apply(s, p):
        s.applied_torque += s.cable_spring_pull


@register
class PositionFriction(Effect):
    """Friction that depends on the angle, for example because of a bent shaft, a worn tooth or a rubbing cable.

    Attributes:
        periods: number of friction periods per turn of the joint.
    """

    name = "position_friction"
    stage = Stage.FRICTION
    equation = "tau_fric += A (1 + cos(n (q - q_w))) / 2"
    source = "eccentric output shaft: one period per turn; range chosen by us"
    parameters = (
        Parameter("position_friction", "N m", 0.0, 0.2, 0.0, 0.0, "A, friction added at the worst angle", least=0.0),
        Parameter("position_friction_angle", "rad", -pi, pi, 0.0, None, "q_w, the worst angle", mirrored=True),
    )
    secants = tuple(
        {"position_friction": 0.05, "position_friction_angle": angle} for angle in (0.0, pi / 2, pi, -pi / 2)
    )
    fingerprint = "odd in velocity; the width of the hysteresis loop changes with the angle"
    confounders = ("coulomb", "load_friction", "dte", "cogging")
    separating_experiment = "slow sweep over the whole range with two loads or in two orientations of the base"
    scopes = ("joint",)

    periods: float = 1.0

    @staticmethod
    def apply(s, p):
        wave = cos(p.position_friction_periods * (s.position - p.position_friction_angle))
        s.friction_bound += 0.5 * p.position_friction * (1.0 + wave)
