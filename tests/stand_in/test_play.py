"""Recordings: what `play` writes down, and how well it repeats."""

import time

import numpy as np
import pytest
import yaml

from op3.motions import Motion, hold, squat
from op3.motions.motion import sample
from op3.robot import pose
from op3.rollout import Rollout
from op3.scenes import build_bench, build_scene
from op3.stand_in import HiddenWorld, StandIn
from op3.stand_in.play import TrunkPush, play
from tests.op3_table import CONTROLLED_JOINTS, indices

LEGS = indices(CONTROLLED_JOINTS)
SHORT = squat(frequency=2.0, knee_high=1.2, duration=0.5)


@pytest.fixture(scope="module")
def squats():
    """The same squat twice on one robot, and the time the first took [s]."""
    robot = StandIn(HiddenWorld(), build_scene("floor", "op3"), seed=5)
    begin = time.process_time()
    first = robot.play(squat(), recording="squat-0")
    duration = time.process_time() - begin
    return first, robot.play(squat(), recording="squat-1"), duration


def paper_loss(a: Rollout, b: Rollout) -> float:
    """Paper eq. (7) over the ten leg joints, with unit weights."""

    def difference(key: str) -> np.ndarray:
        return a.array(key) - b.array(key)

    body = (difference("imu/orientation")[:, :2] ** 2).sum(1) + (difference("imu/angular_velocity") ** 2).sum(1)
    joints = sum((difference(f"joint/{name}")[:, LEGS] ** 2).mean(1) for name in ("position", "velocity", "current"))
    return float((body + joints).mean())


def test_the_squat_is_a_squat(squats):
    """The knee follows from 1.47 to 0.6 rad, currents are a servo's, the robot neither rolls nor falls."""
    log = squats[0]
    knee = log.column("l_knee.position")
    assert np.abs(knee - log.column("l_knee.target")).max() < 0.15
    assert knee.max() - knee.min() > 0.8
    assert 0.2 < np.abs(log.array("joint/current")).max() < 1.0
    assert np.abs(log.array("imu/orientation")[:, 0]).max() < 0.02
    assert log.metadata.fallen is False
    log.check()


def test_the_first_rows_are_at_rest(squats):
    """The recording begins with a robot that stands still, at the first target but for its sag."""
    for log in squats[:2]:
        assert not log.array("joint/velocity")[:5].any()
        assert np.ptp(log.array("joint/position")[:3], axis=0).max() < 0.002
        assert np.abs(log.array("joint/position")[0] - log.array("command/position")[0]).max() < 0.15


def test_a_row_holds_sensors_and_then_the_command(squats):
    """Row k has the k-th target and the time k / 125 s; the gains are logged in every row."""
    log = squats[0]
    assert log.array("command/position").tolist() == squat().position.tolist()
    assert log.array("time")[:, 0] == pytest.approx(np.arange(625) / 125)
    assert (log.array("command/p_gain") == 6.0).all()
    assert (log.array("command/d_gain") == 0.1).all()


def test_repeats_agree_to_the_noise_floor(squats):
    """The same command twice differs, but by less than 0.002 in the paper's loss."""
    assert 0 < paper_loss(*squats[:2]) < 0.002


def test_faster_than_real_time(squats):
    """A 5 s squat with 1.5 s of settling takes less processor time than it lasts."""
    assert squats[2] < 6.5


def test_equal_seeds_give_equal_bytes():
    """Two robots of one world and one seed record the same bytes, recording after recording."""
    a, b = (
        StandIn(HiddenWorld(), build_scene("floor", "op3"), seed=4),
        StandIn(HiddenWorld(), build_scene("floor", "op3"), seed=4),
    )
    for _ in range(2):
        first, second = a.play(SHORT, settle=0.2), b.play(SHORT, settle=0.2)
        for key in first.channels:
            assert first.array(key).tobytes() == second.array(key).tobytes()


@pytest.mark.parametrize("change", ["seed", "world", "repeat"])
def test_another_seed_world_or_repeat_differs(change):
    """Noise differs with the seed and the repeat, the robot with the world."""
    robot = StandIn(HiddenWorld(), build_scene("floor", "op3"), seed=4)
    log = robot.play(SHORT, settle=0.2)
    if change == "repeat":
        other = robot.play(SHORT, settle=0.2)
    else:
        world = HiddenWorld.random(1) if change == "world" else HiddenWorld()
        other = StandIn(world, build_scene("floor", "op3"), seed=5 if change == "seed" else 4).play(SHORT, settle=0.2)
    for key in ("joint/position", "joint/current", "imu/angular_velocity"):
        assert (log.array(key) != other.array(key)).any()


def test_metadata_holds_no_truth():
    """Nothing in the metadata is a number of the world, nor names it; the identity and the seed are there."""
    world = HiddenWorld.random(11)
    log = StandIn(world, build_scene("stand", "op3"), seed=3).play(SHORT, settle=0.1, recording="squat-0")
    metadata = yaml.safe_load(log.metadata.to_yaml())
    assert metadata["extra"] == {"world": world.identity}
    assert metadata["seed"] == 3
    assert metadata["mount"] == "stand"
    assert metadata["robot"] == "simulated"
    hidden = {value for value in vars(world).values() if value not in (0, 1)}
    assert not hidden & {value for value in metadata.values() if isinstance(value, int | float)}
    assert set(metadata) <= {
        *("joints", "robot", "mount", "rate", "battery", "servo", "motion", "recording"),
        *("seed", "fallen", "complete", "extra", "robot_file"),
    }
    # The nominal battery says nothing about the real one.
    assert (
        metadata["battery"]
        == StandIn(HiddenWorld(bus_voltage=12.6), build_scene("stand", "op3")).play(SHORT, settle=0.1).metadata.battery
    )


def test_a_fall_is_written_down():
    """A robot without gains collapses, and the metadata says so."""
    straight = Motion(np.arange(250) / 125, np.tile(pose("zero", "op3"), (250, 1)), name="collapse", robot="op3")
    log = StandIn(HiddenWorld(foot_friction=0.7), build_scene("floor", "op3")).play(
        straight, p_gain=0.0, d_gain=0.0, settle=0.0
    )
    assert log.metadata.fallen is True


def test_low_gains_sag_more():
    """A quarter of the gain in one knee, asked per joint, lets that knee sink further."""
    gains = np.full(20, 6.0)
    gains[indices(["l_knee"])] = 1.5
    soft = StandIn(HiddenWorld(), build_scene("stand", "op3")).play(
        hold(pose("stand", "op3"), 0.2, robot="op3"), p_gain=gains, settle=0.5
    )
    stiff = StandIn(HiddenWorld(), build_scene("stand", "op3")).play(
        hold(pose("stand", "op3"), 0.2, robot="op3"), settle=0.5
    )
    error = [np.abs(log.column("l_knee.position") - log.column("l_knee.target")).max() for log in (soft, stiff)]
    assert error[0] > 1.5 * error[1]
    assert (soft.column("l_knee.p_gain") == 1.5).all()


def test_slow_and_partial_motions():
    """A motion at another rate is held between its rows; joints it does not name stay in the pose "stand"."""
    motion = Motion(np.array([0.0, 0.016, 0.048]), np.array([[0.1], [0.2], [0.3]]), ("head_pan",), robot="op3")
    targets = sample(motion, 0.008)
    assert targets[:, 0].tolist() == [0.1, 0.1, 0.2, 0.2, 0.2, 0.2, 0.3]
    assert (targets[:, 1:] == pose("stand", "op3")[1:]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"p_gain": -1.0}, "p_gain must be finite and at least 0"),
        ({"d_gain": np.ones(3)}, r"d_gain must be one number, one per joint \(20\)"),
        ({"p_gain": "stiff"}, "p_gain must be one number"),
        ({"settle": -1.0}, "settle must be at least 0 s"),
        ({"settle": float("inf")}, "settle must be at least 0 s"),
    ],
)
def test_bad_arguments(arguments, message):
    """They are refused before anything moves."""
    with pytest.raises(ValueError, match=message):
        StandIn(HiddenWorld(), build_scene("stand", "op3")).play(SHORT, **arguments)


def test_targets_beyond_the_soft_limits_are_refused():
    """The message names joint, angle and limits."""
    with pytest.raises(
        ValueError, match=r"commands head_pan to 2\.000 rad at 0\.000 s; its limits are -1\.571 and 1\.571"
    ):
        StandIn(HiddenWorld(), build_scene("stand", "op3")).play(
            Motion(np.array([0.0, 1.0]), np.full((2, 1), 2.0), ("head_pan",), robot="op3")
        )


def test_the_bench_plays_a_motion_of_its_own():
    """The pendulum follows a motion of its joint; it has no IMU and cannot fall."""
    motion = Motion(np.arange(60) / 125, np.linspace(0, 0.5, 60)[:, None], ("servo",), robot="bench")
    log = StandIn(HiddenWorld(), build_bench()).play(motion, metadata={"mass": 0.5, "length": 0.15})
    assert abs(log.column("servo.position")[-1] - 0.5) < 0.2
    assert log.metadata.fallen is None
    assert not [name for name in log.channels if "imu" in name]


def test_a_push_throws_a_robot_off():
    """A stumbling push in the middle of a squat rolls the trunk; without it, it hardly moves; the stand holds it."""
    calm, pushed = (
        play(
            StandIn(HiddenWorld(), build_scene("floor", "op3"), seed=1),
            hold(pose("stand", "op3"), 0.6, robot="op3"),
            6.0,
            0.1,
            pushes=pushes,
        )
        for pushes in ((), (TrunkPush(0.1, (0.0, 12.0, 0.0)),))
    )
    roll = [np.abs(log.array("imu/orientation")[:, 0]).max() for log in (calm, pushed)]
    assert roll[0] < 0.02 < roll[1]
    with pytest.raises(ValueError, match="the trunk is held"):
        StandIn(HiddenWorld(), build_scene("stand", "op3")).push((1.0, 0.0, 0.0), 0.1)


@pytest.mark.parametrize("seed", [-1, 1.5, "a", True])
def test_bad_seeds(seed):
    """A seed is a whole number of at least 0."""
    with pytest.raises(ValueError, match="seed must be an integer"):
        StandIn(HiddenWorld(), build_scene("stand", "op3"), seed=seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_random_worlds_can_squat(seed):
    """No robot of a random world falls over, and its squat repeats."""
    robot = StandIn(HiddenWorld.random(seed), build_scene("floor", "op3"))
    first, second = robot.play(squat()), robot.play(squat())
    assert not first.metadata.fallen
    assert not second.metadata.fallen
    assert paper_loss(first, second) < 0.004
