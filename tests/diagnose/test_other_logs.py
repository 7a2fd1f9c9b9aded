"""Logs that are not like those of the bench: other rates, channels, noise and lengths."""

import numpy as np
import pytest

from op3.diagnose import Diagnosis, LogSplit, WindowResiduals, split_logs
from op3.diagnose.locate import remaining
from op3.diagnose.motion import period_of, smooth
from op3.diagnose.show import show
from op3.robot import leg_suite
from op3.rollout import Metadata, Rollout
from op3.sim import load_model
from op3.stand_in import draw_case, record_case
from op3.tasks import Replay
from op3.tasks.setups import Setup


@pytest.fixture(scope="module")
def leg() -> list[Rollout]:
    """Eight runs of a sound leg, two commands of them twice."""
    return list(record_case(draw_case(9002, "null", robot="leg"), leg_suite(9002)[:8]))


def without(log: Rollout, *names: str, rows: int | None = None) -> Rollout:
    arrays = {key: log.array(key)[:rows] for key in log.channels if "/".join(key) not in names}
    return Rollout.from_arrays(arrays, log.metadata)


def ticking(rate: float, stamps=lambda time: time, told: float | None = None) -> Rollout:
    """Two seconds of one joint at this rate, with stamps as a recorder writes them."""
    time = np.arange(round(2 * rate)) / rate
    angle = 0.3 * np.sin(3 * time)[:, None]
    metadata = Metadata(joints=("r_knee",), robot="simulated", mount="stand", rate=told or rate)
    return Rollout.from_arrays({"time": stamps(time), "joint/position": angle, "command/position": angle}, metadata)


@pytest.mark.parametrize("rate", [50.0, 60.0, 125.0, 150.0, 400.0, 500.0])
def test_the_time_between_rows_is_what_it_is(rate):
    """No rate is rounded to whole milliseconds, also where the stamps are; every row has its own tick."""
    for stamps in (lambda time: time, lambda time: np.round(time, 3)):
        log = ticking(rate, stamps)
        assert period_of(log) == pytest.approx(1 / rate, rel=1e-9)
        assert len(smooth(log).time) == log.rows
    assert period_of(ticking(100.0, told=125.0)) == pytest.approx(0.01, rel=1e-9)


def test_windows_last_as_long_at_any_rate(leg):
    """A window lasts 0.2 s, in simulation steps of at most a millisecond that a tick is made of."""
    for step in (2, 1):
        thinned = [
            Rollout.from_arrays(
                {key: log.array(key)[::step] for key in log.channels}, log.metadata.replace(rate=125.0 / step)
            )
            for log in leg
        ]
        engine = WindowResiduals(split_logs(thinned), fit_windows=4, select_windows=2)
        assert engine.ticks * engine.period == pytest.approx(0.2, abs=engine.period)
        assert engine.timestep <= 0.001
        assert engine.period / engine.timestep == pytest.approx(round(engine.period / engine.timestep))


@pytest.mark.parametrize(("period", "step"), [(0.008, 0.001), (0.02, 0.001), (0.0025, 0.0025 / 3)])
def test_a_robots_commands_come_as_often_as_rows(leg, period, step):
    """A replay ticks at the rate of the log, in whole steps of at most a millisecond."""
    setup = Setup.of_mount("stand", joints=leg[0].joints, control_period=period)
    assert setup.control_period == period
    assert setup.mj_model.opt.timestep == pytest.approx(step)
    slower = Rollout(leg[0].data, leg[0].metadata.replace(extra={"control_rate": 62.5}))
    either = Replay([leg[0], slower], duration=0.5).run(load_model("paper"))
    currents = [prediction.channels["joint", "current"] for prediction in either]
    assert not np.allclose(*currents, atol=1e-3)


def test_a_noisy_velocity_is_no_gap(leg):
    """What is left is told in standard deviations of these logs' readings, not of usual ones."""
    rng = np.random.default_rng(4)
    noisy = []
    for log in leg:
        arrays = {key: log.array(key) for key in log.channels}
        arrays["joint", "velocity"] = arrays["joint", "velocity"] + rng.normal(
            0, 0.1, arrays["joint", "velocity"].shape
        )
        noisy.append(Rollout.from_arrays(arrays, log.metadata))
    usual = []
    for logs in (leg, noisy):
        engine = WindowResiduals(split_logs(logs), fit_windows=12, select_windows=6)
        engine.prepare(load_model("paper"))
        usual.append(float(np.median(remaining(engine, engine.residuals(load_model("paper"))[0]))))
    assert usual[1] < usual[0]  # the gap is the same, the noise five times as large


def test_speeds_are_known_without_velocities(leg):
    """Where a drag begins is told by the speeds that joints had; of logs without velocities, by their angles."""
    split = split_logs([without(log, "joint/velocity") for log in leg])
    diagnosis = Diagnosis(load_model("paper"), split, engine=WindowResiduals(split, fit_windows=8, select_windows=4))
    speeds = diagnosis.refits._speeds()
    assert np.isfinite(speeds).all()
    assert np.abs(speeds).max() > 0.1


def test_repeats_may_differ_by_a_row_and_in_digits(leg):
    """Runs of one command stay together, and the gap between them and its floor are told over what they share."""
    uneven = [without(log, rows=log.rows - i % 3) for i, log in enumerate(leg)]
    split = split_logs(uneven)
    assert [len(group) for group in split.repeats] == [len(group) for group in split_logs(leg).repeats]
    assert split.repeats
    model = load_model("paper")
    for entry in show(model, model, split)["gap"].values():
        assert 0 < entry["floor"] < entry["before"]


def test_a_log_that_is_there_twice_counts_once(leg):
    """What a simulation gives for the same seed is no repeat, whatever the copy is called."""
    copies = [Rollout(log.data, log.metadata.replace(recording="copy")) for log in leg]
    assert len(split_logs([*leg, *copies]).logs) == len(leg)


def test_repeats_go_one_way_together(leg):
    """With little else to fit, all runs of a command fit, choose or show; none is in two places."""
    several = [leg[0], leg[3], leg[5], *(without(log, rows=log.rows - 1) for log in (leg[0], leg[3]))]
    few = split_logs(several)
    motions = [{log.metadata.motion for log in part} for part in (few.fit, few.select, few.show)]
    assert not motions[0] & motions[2]
    assert not (motions[0] | motions[2]) & motions[1]
    assert sum(map(len, motions)) == 3


def test_repeats_are_one_piece_of_evidence(leg):
    """The interval of a gap does not shrink because every run is there twice."""
    model = load_model("paper")
    once = LogSplit((), (), tuple(leg[-2:]))
    again = [Rollout(log.data, log.metadata) for log in leg[-2:]]
    twice = LogSplit((), (), (*leg[-2:], *again), ((0, 2), (1, 3)))
    widths = []
    for split in (once, twice):
        low, high = show(model, model, split)["gap"]["joint/current"]["before_interval"]
        widths.append(high - low)
    assert widths[1] == pytest.approx(widths[0], rel=0.03)  # other draws of the bootstrap
