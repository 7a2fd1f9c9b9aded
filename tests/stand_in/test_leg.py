"""One leg with hidden effects: same seeds same bytes, nothing at size zero, each effect visible where it should be."""

import numpy as np
import pytest

from op3.robot import LEG_JOINTS, Excitation, build_scene, indices, leg_suite, leg_walking
from op3.robot.motions import Motion
from op3.rollout import Rollout
from op3.stand_in import CATALOGUE, KINDS, OUTSIDERS, Hidden, LegTruth, StandIn, World, record_leg

WORLD = World(
    joint_spread=0.0,
    friction_drift=0.0,
    torque_noise=0.0,
    current_offset=0.0,
    current_noise=0.0,
    latency_jitter=0.0,
    placement=0.0,
)
"""A leg without noise, so that a difference is the effect's."""

NAMES = tuple(KINDS)


def short_suite(seed: int = 3) -> list[Excitation]:
    """Most of a second each of multisine, steps and squats, cold and warm."""
    suite = leg_suite(seed, duration=0.8)
    return [suite[i] for i in (2, 5, 7, 11, 22)]


def record(*hidden: Hidden, world: World = WORLD, seed: int = 0) -> list[Rollout]:
    return record_leg(LegTruth(world, hidden), short_suite(), seed)


def channels(logs: list[Rollout], name: str) -> np.ndarray:
    """[run, time, joint]."""
    return np.stack([log.array(name) for log in logs])


def change(name: str, one: list[Rollout], other: list[Rollout]) -> np.ndarray:
    """Root mean square difference of a channel by joint."""
    return np.sqrt(((channels(one, name) - channels(other, name)) ** 2).mean((0, 1)))


def place(name: str) -> tuple[str, ...]:
    return KINDS[name].joints[:1]


@pytest.fixture(scope="module")
def bare() -> list[Rollout]:
    return record(world=World())


def test_same_seed_same_bytes(bare):
    """Equal seeds record equal logs, channel by channel to the last bit; another seed does not."""
    again, other = record(world=World()), record(world=World(), seed=1)
    for one, two in zip(bare, again, strict=True):
        assert one.metadata == two.metadata
        for key in one.channels:
            assert one.array(key).tobytes() == two.array(key).tobytes()
    assert channels(bare, "joint/current").tobytes() != channels(other, "joint/current").tobytes()


@pytest.fixture(scope="module")
def quiet() -> list[Rollout]:
    return record()


@pytest.mark.parametrize("which", [0, -1])
def test_effects_of_size_zero_are_none(which, bare):
    """Everything that can be hidden, all at once at size zero, changes no bit of any log."""
    hidden = [Hidden(name, 0.0, place(name), KINDS[name].forms[which]) for name in NAMES]
    for one, two in zip(bare, record(*hidden, world=World()), strict=True):
        for key in one.channels:
            assert one.array(key).tobytes() == two.array(key).tobytes(), key


_BY_WORLD = ("dte", "stribeck", "latency")
_WHOLE_LEG = ("encoder_offset", "link_mass", "link_com", "link_inertia")
_SHOWN = [(name, form) for name in NAMES if name not in _BY_WORLD for form in KINDS[name].forms]


@pytest.mark.parametrize(
    ("name", "form"),
    [pytest.param(n, f, marks=[] if f == KINDS[n].forms[0] else pytest.mark.slow) for n, f in _SHOWN],
)
def test_a_strong_effect_shows_where_it_sits(name, form, quiet):
    """At five times the smallest size an effect moves positions or currents beyond a count, most in its own joint."""
    kind = KINDS[name]
    logs = record(Hidden(name, kind.size(5.0), place(name), form))
    position, current = change("joint/position", logs, quiet), change("joint/current", logs, quiet)
    assert position.max() > 0.5e-3 or current.max() > 2.7e-3
    if kind.joints and name not in _WHOLE_LEG:
        here = LEG_JOINTS.index(place(name)[0])
        # a torque on one joint shakes its neighbours too
        assert max(current[here] / current.max(), position[here] / position.max()) > 0.8


def test_dte_costs_current_only_where_the_load_drives():
    """A gear that is hard to back-drive takes less current to lower a load with, and as much to lift it."""
    time = np.arange(375) / 125
    angle = 0.2 * np.sin(2 * np.pi * time / 3)
    position = np.zeros((375, len(LEG_JOINTS)))
    position[:, 1] = -0.5
    position[:, 2] = 0.9 + angle
    run = Excitation(Motion(time, position, LEG_JOINTS, "slow"))
    loops = []
    for efficiency in (1.0, 0.6):
        (log,) = record_leg(LegTruth(WORLD.replace(backward_efficiency=efficiency)), [run], 0)
        current, velocity = log.array("joint/current")[:, 2], log.array("joint/velocity")[:, 2]
        middle = np.abs(angle) < 0.1
        loops.append((current[middle & (velocity > 0.05)].mean(), current[middle & (velocity < -0.05)].mean()))
    lifting, lowering = np.abs(np.array(loops)).T if abs(loops[0][0]) > abs(loops[0][1]) else np.abs(loops)[:, ::-1].T
    assert lowering[0] - lowering[1] > 0.02
    assert abs(lifting[1] - lifting[0]) < 0.3 * (lowering[0] - lowering[1])


def test_latency_moves_the_current_in_time():
    """12 ms more delay shifts the measured current against the PD's demand by as much."""

    def lag(latency: float) -> float:
        logs = record_leg(LegTruth(WORLD.replace(command_latency=latency)), short_suite()[1:2], 0)
        log = logs[0]
        wanted = 6.0 * (log.array("command/position") - log.array("joint/position")) - 0.1 * log.array("joint/velocity")
        got = log.array("joint/current")
        error = [((got[8:, 3] - wanted[8 - k : len(wanted) - k, 3]) ** 2).mean() for k in range(6)]
        return 0.008 * int(np.argmin(error))

    assert lag(0.0175) - lag(0.0055) == pytest.approx(0.012, abs=0.0045)


def test_a_current_offset_is_there_at_rest_and_an_encoder_offset_is_not_seen_by_its_own_encoder():
    """A sensor's zero of 40 mA changes what holding takes by 40 mA at most; an encoder's zero shifts the true angle."""
    still = Motion(np.arange(125) / 125, np.tile([0, 0, 0.6, -1.1, -0.5, 0.0], (125, 1)), LEG_JOINTS, "still")
    plain = record_leg(LegTruth(WORLD), [Excitation(still)], 0)[0].array("joint/current")[-1]
    hidden = Hidden("current_offset", 0.04, ("r_knee",))
    moved = record_leg(LegTruth(WORLD, (hidden,)), [Excitation(still)], 0)[0].array("joint/current")[-1]
    assert 0 < abs(moved - plain)[3] <= 0.041
    encoder = Hidden("encoder_offset", 0.03, ("r_hip_pitch",))
    log = record_leg(LegTruth(WORLD, (encoder,)), [Excitation(still)], 0)[0]
    assert log.array("joint/position")[0, 2] == pytest.approx(0.6, abs=0.03)


def test_backlash_lets_the_link_fly_through_the_gap():
    """A tooth gap passes no torque inside and the stiffness of teeth outside it."""
    from op3.stand_in.leg_servos import _Gear  # the law itself, which logs show only indirectly

    gear = _Gear([3], np.array([0.005]), 250.0, 0.06, 0.004, "dead_zone")
    gear.position, gear.velocity = np.array([[0.003]]), np.zeros((1, 1))
    zero = np.zeros((1, 1))
    assert gear.torque(zero, zero) == 0
    gear.position = np.array([[0.006]])
    assert gear.torque(zero, zero) == pytest.approx(250.0 * 0.002)
    gear.velocity = np.array([[-100.0]])
    assert gear.torque(zero, zero) == 0  # teeth push and never pull


def test_the_leg_moves_as_it_does_on_the_whole_robot():
    """With the trunk fixed, the leg alone and the same leg on the whole stand-in agree but for quantised sensors."""
    suite = [leg_suite(3, duration=1.5)[5]]
    alone = record_leg(LegTruth(WORLD.replace(bus_resistance=0.0)), suite, 0)[0]
    motion = suite[0].motion
    whole = StandIn(WORLD.replace(bus_resistance=0.0), build_scene("stand"), seed=0).play(motion, 6.0, 0.1, settle=0.8)
    there = whole.array("joint/position")[: len(alone), indices(LEG_JOINTS)]
    here = np.stack([np.interp(whole.array("time")[: len(alone), 0], alone.array("time")[:, 0], column)
                     for column in alone.array("joint/position").T], 1)  # fmt: skip
    assert np.sqrt(((here - there) ** 2).mean()) < 4e-3
    assert np.ptp(there[:, 3]) > 0.3


def test_suites_stay_within_limits_and_repeat_their_commands():
    """The rich suite has about 100 s, two commands four times each, warm and tilted runs; walking has neither."""
    suite, walking = leg_suite(1), leg_walking(1)
    assert 95 < sum(len(run.motion.time) / 125 for run in suite) < 110
    repeated = [run for run in suite if run.motion.name == "repeated_multisine"]
    assert len(repeated) == 4
    assert all(np.array_equal(run.motion.position, repeated[0].motion.position) for run in repeated)
    assert {run.tilt for run in suite} == {(0.0, 0.0), (0.5, 0.8)}
    assert any(run.warm for run in suite)
    assert not any(run.warm or run.tilt != (0.0, 0.0) for run in walking)


def test_the_table_separates_catalogue_and_outsiders():
    """Nothing is in both lists, and every local effect names joints of the leg."""
    assert not set(CATALOGUE) & set(OUTSIDERS)
    assert len(CATALOGUE) >= 24
    assert len(OUTSIDERS) == 5
    assert all(set(kind.joints) <= set(LEG_JOINTS) for kind in KINDS.values())
    with pytest.raises(ValueError, match="nothing called 'rust'"):
        Hidden("rust", 1.0)
