"""Every tuned number of the judge, in one table, each with its reason."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Tuned constants; torques are in `torque_unit`s, one hundredth of what the robot's busiest joint gives.

    Attributes:
        spike: torque up to which every law is a little wrong, root mean square [units]. Sound robots of other
            simulators leave 0.1 to 0.3 of it behind their best base.
        spike_ends: the spike as a share of the slab, least and most: an effect that hardly shows may be there, and one
            that shows in every window needs room to be found.
        slab: standard deviation of a finding's size, as a share of what is plausible for it.
        faulty: how many times larger than plausible of a sound robot a fault may be.
        edge: how many standard deviations an edge-of-sticking window may move when the base's numbers move by
            `edge_share`.
        edge_share: by how much no law's numbers are known [-].
        tails: degrees of freedom of Student's noise: a window in ten is wild where joints stick and slip.
        noise: usual noise of a joint [units], a log-normal's median; estimated per joint about it.
        noise_spread: standard deviation of its logarithm.
        law: usual size of what a joint does and nobody explains [units], estimated per joint about it.
        law_spread: standard deviation of its logarithm, and of that of the servos' spread.
        features: of a joint's unexplained law; twice as many change no name.
        alarm: log odds from which on a candidate is proposed: what sound robots reach now and then.
        threshold: standard errors over runs by which a model has to predict runs that were left out better with an
            effect than without, at which it is as likely there as not.
        steepness: by which each further standard error multiplies the odds, as a logarithm.
        least_load: share of a joint's torque that an effect has to make to matter.
        least_floor: ratio to the noise of one window's torque, current or rate that an effect has to have to matter:
            25 windows show a fifth.
        form: standard deviation of a finding's size, as a share of it: no law is quite the robot's, and of eleven sizes
            found on robots of another simulator ten were off by 2 to 28 %.
        windows: of the fitted runs; more add what model error repeats. None: five of each run, at least 72.
        leaders: candidates that are estimated anew with everything else in each round.
    """

    spike: float = 0.2
    spike_ends: tuple[float, float] = (0.02, 0.4)
    slab: float = 0.5
    faulty: float = 1.6
    edge: float = 2.0
    edge_share: float = 0.05
    tails: float = 4.0
    noise: float = 0.3
    noise_spread: float = 0.7
    law: float = 0.15
    law_spread: float = 0.5
    features: int = 40
    alarm: float = 6.0
    threshold: float = 2.0
    steepness: float = 2.0
    least_load: float = 0.01
    least_floor: float = 0.2
    form: float = 0.2
    windows: int | None = None
    leaders: int = 6


SETTINGS = Settings()

FLOORS = {("joint", "position"): 0.0005, ("joint", "velocity"): 0.010, ("joint", "current"): 0.0035}
"""Of a reading [rad, rad/s, A]: a count of a 4096-step encoder and of 0.024 rad/s over sqrt(12), and a little more
(ROBOTIS e-Manual, XM430; Feetech's magnetic encoders have as many steps). A current is noisier than its count of
2.69 mA, by how much no maker says: 1.3 counts are our own choice."""

PIECES = 4
"""Pieces of a window in each of which the torque is constant."""
