"""Errors of the servo's sensors."""

from math import cos, exp, pi, sin, sqrt
from typing import Literal

from op3.servo.effect import Effect, Parameter, Stage, Usual, register
from op3.servo.law import lags_per_step

BENT = 0
"""Index of the option ``bent`` in its list."""


@register
class EncoderOffset(Effect):
    """The encoder's zero is not the joint's zero."""

    name = "encoder_offset"
    stage = Stage.SENSING
    equation = "q_measured = q + b"
    source = "homing of a servo horn; -0.126 rad fits the STS3032 on Rhoban's servo bench"
    parameters = (Parameter("encoder_offset", "rad", -0.2, 0.2, 0.0, 0.0, "reading at the joint's true zero"),)
    secants = ({"encoder_offset": 0.01},)
    fingerprint = "a constant angle: the phase of the gravity torque is shifted; foot pose and IMU disagree with angles"
    confounders = ("link_com", "com_offset", "cable_spring", "current_offset", "encoder_nonlinearity")
    separating_experiment = "two orientations of the base: gravity turns with it; IMU against forward kinematics"

    @staticmethod
    def sense(s, p):
        s.measured_position += p.encoder_offset


@register
class EncoderNonlinearity(Effect):
    """The encoder's error depends on the angle, for example because of an off-centre magnet.

    Attributes:
        velocity: ``bent``: the servo computes its velocity from this reading. ``apart``: the velocity comes from the
            motor's own sensor or is corrected, and only the angle has the error.
    """

    name = "encoder_nonlinearity"
    written = {"velocity": ("bent", "apart")}
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
    fingerprint = "an angle error that repeats every turn and appears between IMU and kinematics"
    confounders = ("encoder_offset", "link_com", "cable_spring", "cogging")
    separating_experiment = "slow sweep over the whole range, IMU against forward kinematics"
    scopes = ("joint",)

    velocity: Literal["bent", "apart"] = "bent"

    @staticmethod
    def sense(s, p):
        """Add the error to the reading, and to the velocity if the servo computes it from the reading."""
        angle = s.position + p.encoder_nonlinearity_phase
        s.measured_position += p.encoder_nonlinearity * sin(angle)
        if p.encoder_nonlinearity_velocity == BENT:
            s.measured_velocity *= 1.0 + p.encoder_nonlinearity * cos(angle)


@register
class VelocityFilter(Effect):
    """The servo filters its reported velocity; the discretisation is exact for linearly changing velocity.

    Any velocity estimate has a mean delay Tw, and the variance of its impulse response is Tw^2 (1 - 2 a). One lag has
    the shape a = 0, two equal lags in series 1/4, a difference of angles 1/3, a pure delay 1/2.
    """

    name = "velocity_filter"
    stage = Stage.SENSING
    rank = 1
    equation = "a Tw^2 d2w_measured/dt2 + Tw dw_measured/dt = w - w_measured"
    source = "velocity estimate of a servo's firmware, which no maker publishes; range chosen by us, from bench logs"
    parameters = (
        Parameter("velocity_time_constant", "s", 0.0, 0.02, 0.0, 0.0, "Tw", least=0.0),
        Parameter("velocity_filter_shape", "-", 0.0, 0.5, 0.0, None, "a", least=0.0, most=0.5, searched=False),
    )
    # no maker publishes how present velocity is averaged; in bench logs of an STS3032 it is 17 ms late, of an XL330 20
    # ms or more (`velocity_sensing` in op3/replay/smoothing.py), so nothing up to 20 ms is a fault; the shape of one
    # lag is 0, of two alike 1/4, of a difference of angles 1/3, of a filter of Butterworth's 1/2
    usual = {
        "velocity_time_constant": Usual(0.006, 0.006, 0.008, 0.04),
        "velocity_filter_shape": Usual(0.25, 0.25, 0.15, 0.5),
    }
    memory = ("filtered", "slope", "velocity", "said", "said_slope", "now", "knows")
    constants = ("lag", "transition_11", "transition_12", "transition_21", "transition_22")
    secants = ({"velocity_time_constant": 0.002}, {"velocity_time_constant": 0.008})
    fingerprint = "reported velocity lags the derivative of the reported angle; no torque beyond Kd"
    confounders = ("latency", "current_lag", "terminal_resistance")
    separating_experiment = "fast motion: reported velocity against the derivative of the angle"
    scopes = ("joint", "shared")

    @staticmethod
    def prepare(p):
        """Lag in steps, and the matrix exponential that advances a deviation, and its slope times Tw, by a step."""
        passed, shape = lags_per_step(p.velocity_time_constant, p.timestep), max(p.velocity_filter_shape, 1e-6)
        p.velocity_filter_lag = p.velocity_time_constant / p.timestep
        if 1.0 - 4.0 * shape > 1e-8:
            root = sqrt(1.0 - 4.0 * shape)
            slow, fast = exp(-2.0 * passed / (1.0 + root)), exp(-passed * (1.0 + root) / (2.0 * shape))
            middle, apart = (slow + fast) / 2.0, (slow - fast) / root
        else:
            root = sqrt(max(4.0 * shape - 1.0, 1e-8))
            angle, fade = passed * root / (2.0 * shape), exp(-passed / (2.0 * shape))
            middle, apart = fade * cos(angle), 2.0 * fade * sin(angle) / root
        p.velocity_filter_transition_11, p.velocity_filter_transition_12 = middle + apart / 2.0, shape * apart
        p.velocity_filter_transition_21, p.velocity_filter_transition_22 = -apart, middle - apart / 2.0

    @staticmethod
    def reset(s, p):
        """The filter starts in steady state, as after a long time at constant velocity."""
        s.velocity_filter_filtered = s.velocity_filter_velocity = s.measured_velocity
        s.velocity_filter_slope = 0.0
        s.velocity_filter_knows = 1.0

    @staticmethod
    def sense(s, p):
        """Update the filter for the last step."""
        now = s.measured_velocity
        s.velocity_filter_now = s.velocity_filter_said = now
        if s.velocity_filter_knows == 0.0:
            return
        ramp = p.velocity_filter_lag * (now - s.velocity_filter_velocity)
        off, bent = s.velocity_filter_filtered - s.velocity_filter_velocity + ramp, s.velocity_filter_slope - ramp
        s.velocity_filter_said = now - ramp + p.velocity_filter_transition_11 * off
        s.velocity_filter_said += p.velocity_filter_transition_12 * bent
        s.velocity_filter_said_slope = ramp + p.velocity_filter_transition_21 * off
        s.velocity_filter_said_slope += p.velocity_filter_transition_22 * bent
        s.measured_velocity = s.velocity_filter_said

    @staticmethod
    def finish(s, p):
        """Store the filtered velocity for the next step."""
        s.velocity_filter_filtered, s.velocity_filter_velocity = s.velocity_filter_said, s.velocity_filter_now
        s.velocity_filter_slope = s.velocity_filter_said_slope
