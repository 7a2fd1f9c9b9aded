"""The tuned constants of the diagnosis in one table, and the constants of its windows.

All other constants of the package are labelled in their docstrings: *numerical* (a grid or a tolerance), *budget* (more
costs time and changes little), *data sheet* or *display*.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Tuned constants. Torques are in torque units: one hundredth of the 95 % quantile of the busiest joint's torque.

    Attributes:
        spike: RMS torque of the inevitable error of a law [torque units], the scale of the spike prior. Sound robots of
            other simulators have 0.1 to 0.3 after their best baseline fit.
        spike_range: smallest and largest spike as a share of the slab.
        slab: standard deviation of a finding's size as a share of the catalogue's range.
        fault_factor: largest size of a fault as a multiple of the catalogue's range.
        edge: standard deviations of the extra noise of windows in which a joint is about to stick.
        edge_share: relative change of the baseline's parameters that defines how sensitive such a window is.
        tails: degrees of freedom of Student's noise; about one window in ten is an outlier where joints stick and slip.
        noise: median of the log-normal prior of a joint's noise [torque units].
        noise_spread: standard deviation of the logarithm of that prior.
        unmodelled: median of the log-normal prior of a joint's unmodelled torque [torque units].
        unmodelled_spread: standard deviation of its logarithm, also used for the spread between servos.
        features: number of random features of a joint's unmodelled torque; doubling it changes no named effect.
        alarm: log odds above which a candidate is proposed; sound robots rarely reach it. For effects that held-out
            runs do not distinguish, log odds are divided by this value.
        threshold: gain in standard errors over held-out runs at which a finding has probability one half.
        steepness: change of a finding's log odds per standard error.
        min_load: smallest relevant share of a joint's RMS torque.
        min_floor: smallest relevant ratio of an effect to the noise of one window; 25 windows resolve a ratio of 0.2.
        form_error: relative error of a finding's size, because its law only resembles the robot's; ten of eleven
            sizes found on robots of another simulator were off by 2 to 28 %.
        windows: number of windows of the fitted runs; None: five per run, at least 72.
        leaders: hypotheses whose evidence is computed with all other parameters free in each round.
    """

    spike: float = 0.2
    spike_range: tuple[float, float] = (0.02, 0.4)
    slab: float = 0.5
    fault_factor: float = 1.6
    edge: float = 2.0
    edge_share: float = 0.05
    tails: float = 4.0
    noise: float = 0.3
    noise_spread: float = 0.7
    unmodelled: float = 0.15
    unmodelled_spread: float = 0.5
    features: int = 40
    alarm: float = 6.0
    threshold: float = 2.0
    steepness: float = 2.0
    min_load: float = 0.01
    min_floor: float = 0.2
    form_error: float = 0.2
    windows: int | None = None
    leaders: int = 6


SETTINGS = Settings()

FLOORS = {("joint", "position"): 0.0005, ("joint", "velocity"): 0.010, ("joint", "current"): 0.0035}
"""Standard deviations of readings [rad, rad/s, A]. Data sheet: one count of a 4096-step encoder and of 0.024 rad/s,
divided by sqrt(12), plus a small margin (ROBOTIS e-Manual, XM430; Feetech's encoders have the same resolution). Current
is noisier than its count of 2.69 mA; no data sheet states its noise, so 1.3 counts are assumed."""

PIECES = 4
"""Numerical: pieces of a window, each with a constant unmodelled torque."""

MIN_WINDOWS = 72
"""Budget: smallest number of windows of the fitted runs."""
