"""Backlash and elasticity between gear and link, with the rotor as a separate body.

If one of the two effects is on, the rotor's inertia leaves the link's degree of freedom, and motor, gear and
friction act on the rotor. The law integrates it; the link feels the torque in the contact, which is solved together
with the link's velocity at the end of the step: the pair is stable at any stiffness, and only the contact damps it. The
encoder sits on the output, as in the Dynamixel X series. The parts after the backlash, the last wheels and the horn,
turn with the link; they change the rate at which a light foot rattles within the backlash.
"""

from math import copysign, sqrt

import numpy as np

from op3.servo.effect import Effect, Parameter, Stage, register
from op3.servo.machine_code import part

STEADY = 0.25
"""Share of the spring's torque per step that opposes a change of velocity, like an inertia of ``STEADY h^2 K``: from
0.25 on, the scheme is stable at any stiffness, without damping. The inertia is 1 to 5 % of a rotor's."""

UNLOADED = 0.03
"""Load below which a measured motion does not show on which flank a loose gear rests [N m]."""

MOST_BEHIND = 0.5
"""At most this share of the armature turns with the link."""

LEAST_COMPLIANCE = 1e-6
"""Compliance of a rigid transmission, without both effects [rad/(N m)]."""


@part
def behind(p):
    """Inertia after backlash and spring [kg m^2], if there are any."""
    own = 0.0
    if p.backlash_half_gap > 0.0:
        own = p.output_inertia
    elif p.gear_compliance > 0.0:
        own = p.wheel_inertia
    return min(own, MOST_BEHIND * p.armature)


@part
def between(p):
    """Whether there is backlash or a spring between gear and link."""
    return p.backlash_half_gap > 0.0 or p.gear_compliance > 0.0


@part
def rotor_angle(p, position, load_torque):
    """Angle of the rotor [rad] at rest: on the flank that carries the load tau_a [N m], with the spring deflected."""
    return position - np.sign(load_torque) * p.backlash_half_gap - load_torque / p.backlash_stiffness


@part
def rotor_velocity(s):
    """Velocity at the end of the last step; friction stops the rotor but does not reverse it."""
    velocity = s.rotor_velocity + s.rotor_gain * s.velocity
    return 0.0 if s.rotor_slips * velocity < 0.0 else velocity


@register
class Backlash(Effect):
    """Backlash between gear and link: the rotor crosses the gap freely when the transmitted torque changes sign.

    Attributes:
        damping_ratio: damping ratio of the rotor on the contact's stiffness, with the link at rest; half of the loss
            factor.
    """

    name = "backlash"
    stage = Stage.TRANSMISSION
    rank = 1
    equation = "tau = K dz(q_rotor - q, delta), dz(x, delta) = sign(x) max(|x| - delta, 0)"
    source = (
        "X series: 15 arcmin in total, so delta = 2.2 mrad when new; MX: 20 arcmin (ROBOTIS e-Manual); Feetech STS: 0.5"
        " degrees at most; stiffness and inertia chosen by us"
    )
    parameters = (
        Parameter("backlash_half_gap", "rad", 0.0, 0.012, 0.0, 0.0, "delta, half of the backlash", least=0.0),
        Parameter("contact_stiffness", "N m/rad", 100.0, 500.0, 300.0, None, "K, of teeth", least=1.0, searched=False),
        Parameter("output_inertia", "kg m2", 0.0, 0.001, 0.0, None, "J_o, after backlash", least=0.0, searched=False),
    )
    constants = ("stiffness", "friction")
    stiff = True
    secants = tuple(
        {"backlash_half_gap": gap, "contact_stiffness": 300.0, "output_inertia": 0.0005}
        for gap in (0.0015, 0.003, 0.006, 0.010)
    )
    fingerprint = (
        "after a sign change of the transmitted torque: free flight, a jump of velocity, ringing at 20 to 60 Hz; none"
        " of these"
        " while the torque keeps its sign"
    )
    confounders = ("stribeck", "lugre", "compliance", "latency")
    separating_experiment = "holding two loads of opposite sign: the angle differs by the backlash"

    damping_ratio: float = 0.04

    @staticmethod
    def prepare(p):
        """Stiffness of backlash and spring in series, and their torque per velocity difference."""
        compliance, ratio = p.gear_compliance, p.compliance_damping_ratio
        if p.backlash_half_gap > 0.0:
            compliance, ratio = 1.0 / p.contact_stiffness + compliance, p.backlash_damping_ratio
        p.backlash_stiffness = 1.0 / max(compliance, LEAST_COMPLIANCE)
        p.backlash_friction = 2.0 * ratio * sqrt(p.backlash_stiffness * (p.armature - behind(p)))

    @staticmethod
    def reset(s, p):
        """Start with the rotor on the flank that carries the load and moving with the link."""
        if between(p):
            s.rotor_angle = rotor_angle(p, s.position, s.load_torque) - p.timestep * s.velocity
            s.rotor_velocity = s.velocity
            s.rotor_gain = s.rotor_slips = s.rotor_torque = s.contact_torque = 0.0

    @staticmethod
    def begin(s, p):
        """Move the rotor to the end of the last step; motor and friction then act on it instead of the link."""
        if between(p):
            s.rotor_velocity = rotor_velocity(s)
            s.rotor_angle += p.timestep * s.rotor_velocity
            s.position, s.velocity = s.rotor_angle, s.rotor_velocity

    @staticmethod
    def apply(s, p):
        """Solve the steps of rotor and link together, and pass the contact's torque to the link."""
        if not between(p):
            return
        half_gap, stiffness, friction = p.backlash_half_gap, p.backlash_stiffness, p.backlash_friction
        step, steadying = p.timestep, STEADY * p.timestep * stiffness
        grip = steadying + friction  # torque per difference of velocities at the end of the step
        angle, velocity, link_velocity = s.rotor_angle, s.rotor_velocity, s.link_velocity
        rotor = p.armature - behind(p)
        inertia = rotor + step * s.damping
        torque, bound = s.applied_torque, s.friction_bound
        # where the rotor would be without the link decides which flank it meets
        free = velocity + step * torque / inertia
        free = copysign(max(abs(free) - step * bound / inertia, 0.0), free)
        apart = angle - s.link_position
        ends = apart + step * (free - link_velocity)
        side = np.sign(ends) if abs(ends) > half_gap else 0.0
        bent = stiffness * (apart - side * half_gap) - steadying * (velocity - link_velocity)
        if half_gap != 0.0 and not side * (bent + grip * (free - link_velocity)) > 0.0:
            bent, grip = 0.0, 0.0  # it touches neither flank
        # the rotor's velocity after the step: friction holds it, or opposes it
        total = inertia + step * grip
        impulse = inertia * velocity + step * (torque - bent)
        moves = impulse + step * grip * link_velocity
        s.rotor_slips = np.sign(moves) if abs(moves) > step * bound else 0.0
        constant, gain = 0.0, 0.0
        if s.rotor_slips != 0.0:
            constant, gain = (impulse - step * bound * s.rotor_slips) / total, step * grip / total
        s.rotor_velocity, s.rotor_gain = constant, gain
        # the contact's torque is bent + grip (rotor velocity - link velocity), both after the step
        s.rotor_torque = torque
        s.contact_torque = bent + grip * (constant + gain * link_velocity - link_velocity)
        falls = grip * (1.0 - gain)
        s.applied_torque = bent + grip * constant - falls * link_velocity
        s.damping = falls - rotor / step
        s.friction_bound = 0.0

    @staticmethod
    def motor_side(s, p):
        """The rotor's velocity, which causes the back-EMF when the voltage limits the current."""
        if between(p):
            s.velocity = rotor_velocity(s)

    @staticmethod
    def balance(s, p, torque, rests):
        """Place the rotor on the flank that carries the torque, deflected by it, and let it move with the link.

        With a contact this stiff, noise of the measured angle would become a large torque. With almost no load the
        rotor keeps its angle.
        """
        if not between(p):
            return torque
        load = s.contact_torque - torque
        if rests or abs(load) > UNLOADED:
            velocity = 0.0 if rests else s.velocity
            s.rotor_angle = rotor_angle(p, s.position, -load) - p.timestep * velocity
            s.rotor_velocity, s.rotor_gain, s.rotor_slips = velocity, 0.0, 0.0
        return s.rotor_torque - load


@register
class Compliance(Effect):
    """Elasticity of gear train and bracket between rotor and link; in series with backlash if `backlash` is also on.

    Attributes:
        damping_ratio: damping ratio of the rotor on the gear train's stiffness, with the link at rest; half of the loss
            factor.
    """

    name = "compliance"
    stage = Stage.TRANSMISSION
    rank = 1
    equation = "tau = (q_rotor - q) / c"
    source = "spring and damper between rotor and link; stiffness from 50 N m/rad and loss factor 0.08 chosen by us"
    parameters = (
        Parameter("gear_compliance", "rad/(N m)", 0.0, 0.02, 0.0, 0.0, "c = 1 / K", least=0.0),
        Parameter("wheel_inertia", "kg m2", 0.0, 0.001, 0.0, None, "J_o, after the spring", least=0.0, searched=False),
    )
    acts_in = "backlash"
    stiff = True
    # the inertia behind the gears moves the resonance too, and no refit crosses from one period of it to the next
    secants = (
        {"gear_compliance": 0.004, "wheel_inertia": 0.0005},
        {"gear_compliance": 0.008, "wheel_inertia": 0.0008},
        {"gear_compliance": 0.015, "wheel_inertia": 0.0005},
    )
    fingerprint = "an extra resonance at sqrt(1 / (c J)); IMU and kinematics differ in proportion to the load"
    confounders = ("backlash", "lugre", "current_lag", "link_inertia")
    separating_experiment = "increasing static loads, with an IMU or a camera; chirp up to the resonance"

    damping_ratio: float = 0.04
