"""What the servo's sensors say that is not so."""

from math import cos, exp, pi, sin, sqrt
from typing import Literal

from op3.servo.effect import Effect, Parameter, Stage, register
from op3.servo.law import lags_per_step

BENT = 0
"""Place of a velocity that bends with the angle in its list."""


@register
class EncoderOffset(Effect):
    """The encoder's zero is not the joint's zero."""

    name = "encoder_offset"
    stage = Stage.SENSING
    equation = "q_measured = q + b"
    source = "homing of a servo horn; Rhoban's servo bench fits -0.126 rad on its STS3032"
    parameters = (Parameter("encoder_offset", "rad", -0.2, 0.2, 0.0, 0.0, "reading at the joint's true zero"),)
    secants = ({"encoder_offset": 0.01},)
    fingerprint = (
        "a constant angle: gravity of the links acts in another phase; foot pose and IMU disagree with the joint angles"
    )
    confounders = ("link_com", "com_offset", "cable_spring", "current_offset", "encoder_nonlinearity")
    separating_experiment = "turn the base: gravity terms turn with it; compare the IMU with forward kinematics"

    @staticmethod
    def sense(s, p):
        s.measured_position += p.encoder_offset


@register
class EncoderNonlinearity(Effect):
    """The encoder's reading bends with the angle: a magnet that sits off its axis.

    Attributes:
        velocity: ``bent``: the servo computes its velocity from this reading. ``apart``: it has it from the motor's own
            sensor, or corrects it, and the angle alone bends.
    """

    name = "encoder_nonlinearity"
    stage = Stage.SENSING
    equation = "q_measured = q + a sin(q + p)"
    source = (
        "magnet off centre; AS5045, the encoder of Dynamixel X 430 (ROBOTIS e-Manual): 0.5 degrees centred, 1.4"
        " degrees off centre (ams data sheet, INL)"
    )
    parameters = (
        Parameter("encoder_nonlinearity", "rad", -0.03, 0.03, 0.0, 0.0, "a", least=-0.5, most=0.5),
        Parameter("encoder_nonlinearity_phase", "rad", -pi, pi, 0.0, None, "p"),
    )
    secants = (
        {"encoder_nonlinearity": 0.01, "encoder_nonlinearity_phase": 0.0},
        {"encoder_nonlinearity": 0.01, "encoder_nonlinearity_phase": pi / 2},
    )
    fingerprint = "an error of the angle that repeats every turn; IMU against kinematics over the angle"
    confounders = ("encoder_offset", "link_com", "cable_spring", "cogging")
    separating_experiment = "slow sweep over the whole range, IMU against forward kinematics"
    scopes = ("joint",)

    velocity: Literal["bent", "apart"] = "bent"

    @staticmethod
    def sense(s, p):
        """Bend the reading, and with it the velocity if the servo computes it from that."""
        angle = s.position + p.encoder_nonlinearity_phase
        s.measured_position += p.encoder_nonlinearity * sin(angle)
        if p.encoder_nonlinearity_velocity == BENT:
            s.measured_velocity *= 1.0 + p.encoder_nonlinearity * cos(angle)


@register
class VelocityFilter(Effect):
    """The servo filters the velocity that it reports; exact for a velocity that changes linearly.

    Whatever an estimate is made of, it is late by a mean time and smears over the square of it less twice the shape
    (moments of its impulse response). One lag has the shape 0, two alike in a row 1/4, a difference of angles 1/3.
    """

    name = "velocity_filter"
    stage = Stage.SENSING
    rank = 1
    equation = "a Tw^2 d2w_measured/dt2 + Tw dw_measured/dt = w - w_measured"
    source = "velocity estimate of a servo's firmware, which no maker publishes; range our own choice, from bench logs"
    parameters = (
        Parameter("velocity_time_constant", "s", 0.0, 0.02, 0.0, 0.0, "Tw", least=0.0),
        Parameter("velocity_filter_shape", "-", 0.0, 0.5, 0.0, 0.0, "a", least=0.0, most=0.5, searched=False),
    )
    memory = ("filtered", "slope", "next", "velocity", "now", "knows")
    constants = ("late", "kept", "turned", "lost", "bent")
    secants = ({"velocity_time_constant": 0.002}, {"velocity_time_constant": 0.008})
    fingerprint = "reported velocity lags the derivative of the reported angle; no torque beyond Kd"
    confounders = ("latency", "current_lag", "terminal_resistance")
    separating_experiment = "compare reported velocity with the derivative of the angle"
    scopes = ("joint", "shared")

    @staticmethod
    def prepare(p):
        """What a step leaves of a deviation and of its slope times `Tw`: the exponential of a matrix."""
        passed, shape = lags_per_step(p.velocity_time_constant, p.timestep), max(p.velocity_filter_shape, 1e-6)
        p.velocity_filter_late = 1.0 / passed
        root = sqrt(max(abs(1.0 - 4.0 * shape), 1e-8))
        if 4.0 * shape < 1.0:
            slow, fast = exp(-2.0 * passed / (1.0 + root)), exp(-passed * (1.0 + root) / (2.0 * shape))
            middle, apart = (slow + fast) / 2.0, (slow - fast) / root
        else:
            swing, fade = passed * root / (2.0 * shape), exp(-passed / (2.0 * shape))
            middle, apart = fade * cos(swing), 2.0 * fade * sin(swing) / root
        p.velocity_filter_kept, p.velocity_filter_lost = middle + apart / 2.0, middle - apart / 2.0
        p.velocity_filter_turned, p.velocity_filter_bent = shape * apart, -apart

    @staticmethod
    def reset(s, p):
        """The velocity was held for long."""
        s.velocity_filter_filtered = s.velocity_filter_velocity = s.measured_velocity
        s.velocity_filter_slope = 0.0
        s.velocity_filter_knows = 1.0

    @staticmethod
    def sense(s, p):
        """Filter what has happened since the memory was last renewed, a step ago."""
        now = s.measured_velocity
        s.velocity_filter_now = now
        if s.velocity_filter_knows == 0.0:
            return
        ramp = p.velocity_filter_late * (now - s.velocity_filter_velocity)
        deviation = s.velocity_filter_filtered - s.velocity_filter_velocity + ramp
        turned = s.velocity_filter_slope - ramp
        s.measured_velocity = now - ramp + p.velocity_filter_kept * deviation + p.velocity_filter_turned * turned
        s.velocity_filter_next = ramp + p.velocity_filter_bent * deviation + p.velocity_filter_lost * turned

    @staticmethod
    def finish(s, p):
        s.velocity_filter_filtered, s.velocity_filter_velocity = s.measured_velocity, s.velocity_filter_now
        s.velocity_filter_slope = s.velocity_filter_next
