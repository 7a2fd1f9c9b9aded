"""What joints do wrong for a while, what they carry, and what of a motion is no fault."""

from __future__ import annotations

import numpy as np
import pytest
from rollout_logs import SERVO_BENCH

from op3.robot import load_robot
from op3.rollout import Metadata, Rollout, read_episodes
from op3.rollout.health import ERROR, WARNING, examine
from op3.rollout.read import expand

COUNT = 2 * np.pi / 4096
TIME = np.arange(1200) / 100


def rounded(angle: np.ndarray) -> np.ndarray:
    """As an encoder tells it."""
    return np.round(angle / COUNT) * COUNT


def log(
    target: np.ndarray, position: np.ndarray, joints: tuple[str, ...] = (), time: np.ndarray = TIME, **more
) -> Rollout:
    """A log on the stand of these targets and positions [time, joint]; channels and metadata by name."""
    names = joints or tuple(f"joint_{i}" for i in range(target.shape[1]))
    arrays = {"time": time, "command/position": target, "joint/position": rounded(position)}
    arrays |= {name.replace("__", "/"): more.pop(name) for name in [*more] if "__" in name}
    about = {"robot": "real", "mount": "stand", "rate": 1 / float(np.median(np.diff(time))), **more}
    return Rollout.from_arrays(arrays, Metadata(names, **about))


def sines(time: np.ndarray, joints: int = 4) -> np.ndarray:
    """Targets [time, joint]."""
    return 0.5 * np.sin((2.0 + 0.37 * np.arange(joints)) * time[:, None] + np.arange(joints))


TARGET, POSITION = sines(TIME), 0.97 * sines(TIME - 0.04) + 0.01


def let_go(position: np.ndarray, joint: int, first: int, last: int, falls: float, swings: float = 0.0) -> np.ndarray:
    """One joint stands, falls or swings [rad/s] for a while, and comes back."""
    position = position.copy()
    off = np.arange(last - first) / 100
    limp = position[first, joint] - falls * (1 - np.exp(-(1 if swings else 3) * off) * np.cos(swings * off))
    back = np.linspace(limp[-1], position[last + 15, joint], 15)
    position[first : last + 15, joint] = np.concatenate([limp, back])
    return position


@pytest.mark.parametrize("joint", [0, 2])
@pytest.mark.parametrize(("falls", "swings"), [(0, 0), (0.4, 0), (-0.3, 0), (0.3, 8)])
@pytest.mark.parametrize(("first", "last"), [(500, 640), (300, 370)])
def test_a_joint_that_lets_go_for_a_while_is_told(joint, falls, swings, first, last):
    """By its own motion at other times, and because the others go on: it stands, falls or swings."""
    findings = examine(log(TARGET, let_go(POSITION, joint, first, last, falls, swings)))
    assert {one.column for one in findings} == {f"joint_{joint}.position"}
    (found,) = (one for one in findings if one.check == "torque lost")
    assert "its torque was off, or it was blocked" in found.problem
    assert found.rows is not None
    assert first - 25 <= found.rows[0] < found.rows[1] <= last + 40


@pytest.mark.parametrize(("first", "last"), [(400, 460), (900, 1150)])
def test_a_joint_that_should_stand_and_hangs_is_told(first, last):
    """Its target does not change; another joint that is lifted to and fro by what it carries is sound."""
    target, position = TARGET.copy(), POSITION.copy()
    target[:, 1:3] = 0.2
    position[:, 1], position[:, 2] = 0.18, 0.2 + 0.1 * np.sin(2 * TIME)
    (found,) = examine(log(target, let_go(position, 1, first, last, 0.3)))
    assert (found.check, found.column) == ("torque lost", "joint_1.position")
    assert found.rows is not None
    assert first - 25 <= found.rows[0] < found.rows[1] <= last + 40


def test_a_servo_that_gives_no_current_is_told_by_that():
    """However little the joint moves meanwhile."""
    position = let_go(POSITION, 1, 400, 440, 0.05)
    gain = np.full(TARGET.shape, 2.0)
    current = gain * (TARGET - position)
    current[400:440, 1] = 0.0
    found = examine(log(TARGET, position, command__p_gain=gain, joint__current=current))
    assert [(one.check, one.column) for one in found] == [("torque lost", "joint_1.position")]
    assert "the servo had no torque" in found[0].problem
    assert not examine(log(TARGET, POSITION, command__p_gain=gain, joint__current=gain * (TARGET - POSITION)))


@pytest.mark.parametrize(("mount", "told"), [("stand", True), ("floor", False)])
def test_what_moves_all_joints_on_the_floor_is_a_push(mount, told):
    """On a stand they lose their torque."""
    pushed = POSITION + 0.3 * np.exp(-(((TIME - 6) / 0.2) ** 2))[:, None]
    assert ("torque lost" in [one.check for one in examine(log(TARGET, pushed, mount=mount))]) == told


def test_steps_that_every_joint_follows_as_fast_as_it_can_are_sound():
    """No joint lets go."""
    steps = 0.4 * np.sign(np.sin(0.9 * TIME[:, None] + np.arange(4)))
    angle = np.zeros_like(steps)
    for row in range(1, len(steps)):
        angle[row] = angle[row - 1] + 0.12 * (steps[row - 1] - angle[row - 1])
    assert not [one for one in examine(log(steps, angle)) if one.check == "torque lost"]


def arm_log(offset: float, gain: float = 4.0) -> Rollout:
    """An arm whose weak loops sag under their load, and one joint with another zero."""
    arm, target = load_robot("arm"), 0.15 * np.sin(2 * TIME[:, None] + np.arange(6))
    make = arm.servos[0]
    assert make.position_law is not None
    stall = make.output_constant * make.supply.si / make.motor.terminal_resistance.si
    sag = np.array([arm.gravity(angles) for angles in target]) / (gain * make.position_law.error_gain.si * stall)
    position = 0.97 * np.roll(target, 3, axis=0) - sag
    position[:, 2] += offset
    about = {"robot_file": "arm", "servo": "sts3215", "firmware_gain": gain}
    return log(target, position, arm.joints, command__firmware_gain=np.full(target.shape, gain), **about)


@pytest.mark.parametrize(("offset", "told"), [(0.0, []), (0.6, ["elbow_flex.position"])])
def test_what_a_joint_carries_is_no_other_zero(offset, told):
    """Gravity's torque over the stiffness of the servo's loop says how far it sags."""
    found = [one for one in examine(arm_log(offset)) if one.check == "constant offset"]
    assert [one.column for one in found] == told


def test_an_unknown_robot_may_sag():
    """Where the load is unknown the finding says so."""
    position = POSITION.copy()
    position[:, 1] += 0.4
    (found,) = examine(log(TARGET, position))
    assert "unless the joint's load causes it" in found.problem
    assert "a load's effect changes with the pose" in found.remedy


@pytest.mark.parametrize("friction", [0.01, 0.03, 0.06])
@pytest.mark.parametrize("shape", ["triangle", "sine"])
def test_friction_in_slow_motions_is_no_clock(friction, shape):
    """A joint that its friction holds until its command is far enough away, and that follows at that distance."""
    time = np.arange(4000) / 100
    phase = 0.05 * time / 0.3
    target = 0.3 * (np.sin(2 * phase) if shape == "sine" else np.abs((phase + 1) % 4 - 2) - 1)
    held, at = np.empty(len(time)), 0.0
    for row, goal in enumerate(target):
        held[row] = at = min(max(at, goal - friction), goal + friction)
    found = examine(log(target[:, None], held[:, None], ("elbow",), time))
    assert not [one for one in found if one.check == "two clocks"]


def test_a_command_that_is_a_torque_is_refused():
    """It goes with acceleration, friction and gravity, and not with the position."""
    angle = 0.5 * np.sin(2 * TIME) + 0.2 * np.sin(5.3 * TIME)
    speed = np.gradient(angle, TIME)
    torque = 0.05 * np.gradient(speed, TIME) + 0.05 * np.tanh(speed / 0.05) + 0.02 * speed + 0.1 * np.sin(angle)
    found = examine(log(torque[:, None], angle[:, None], ("elbow",)))
    assert [(one.severity, one.column) for one in found if "like a torque" in one.problem] == [(ERROR, "elbow.target")]


@pytest.mark.parametrize("sign", [1, -1])
def test_velocities_scaled_in_one_direction_are_set_aside(sign):
    """In every joint that moves, by the factor."""
    speed = np.gradient(POSITION, TIME, axis=0)
    found = examine(log(TARGET, POSITION, joint__velocity=np.where(sign * speed > 0, 0.8 * speed, speed)))
    word = "positive" if sign > 0 else "negative"
    assert [one.column for one in found] == [f"joint_{i}.velocity" for i in range(4)]
    assert all(f"{word} velocities are 0.8 times" in one.problem and one.set_aside for one in found)


def test_a_side_with_its_signs_turned_round_is_named():
    """Of a robot with two: one knee beyond its limits, and its neighbours by their partners."""
    op3 = load_robot("op3")
    joints = tuple(f"{side}_{name}" for name in ("hip_pitch", "knee", "ank_pitch") for side in "lr")
    bend = 0.3 + 0.3 * np.sin(3 * TIME)
    rows = op3.indices(joints)
    left = {"hip_pitch": -1.0, "knee": 2.0, "ank_pitch": 1.0}
    target = op3.completed({f"l_{name}": size * bend for name, size in left.items()})[:, rows]
    late = op3.completed({f"l_{name}": size * np.roll(bend, 3) for name, size in left.items()})[:, rows]
    signs = np.where([name.startswith("r_") for name in joints], -1, 1)
    sound, wrong = (log(target * s, late * s, joints, robot_file="op3") for s in (1, signs))
    assert not [one for one in examine(sound) if one.check == "limits of the robot"]
    (found,) = (one for one in examine(wrong) if one.check == "limits of the robot")
    assert found.column == "r_knee.position"
    assert "compared with their mirror joints, r_hip_pitch, r_ank_pitch are reversed too" in found.problem


def test_percent_of_a_gripper_among_radians_are_named():
    """And nothing that only follows from that."""
    target, position = (np.hstack([values, 50 + 60 * values[:, :1]]) for values in (TARGET, POSITION))
    found = [one for one in examine(log(target, position)) if one.severity == ERROR]
    assert {one.column for one in found} == {"joint_4.target", "joint_4.position"}
    assert all("percent of a gripper's opening" in one.problem for one in found)


def test_a_joint_that_turns_on_is_read():
    """A lone one that goes beyond a turn without a jump, for a part of the time; in an encoder's steps beyond doubt."""
    target, position = (1.1 * (np.minimum(t, 6.8) - np.maximum(t - 6.9, 0))[:, None] for t in (TIME, TIME - 0.04))
    recorded = log(target, position, ("tilt",))
    assert not [one for one in examine(recorded) if one.check == "bounds"]
    finer = log(target, position, ("tilt",), joint__position=position)
    found = [one for one in examine(finer) if one.check == "bounds"]
    assert {one.severity for one in found} == {WARNING}
    assert any("is reached without a jump" in one.problem for one in found)


@pytest.mark.parametrize(("volts", "told"), [(7.4, False), (8.4, False), (12.0, True), (24.0, True)])
def test_a_supply_beyond_a_servo_is_another_variant(volts, told):
    """A full battery is not."""
    found = examine(log(TARGET, POSITION, servo="sts3215", joint__voltage=np.full(TARGET.shape, volts)))
    assert any("another variant of the sts3215" in one.problem for one in found) == told


def test_a_random_binary_motion_has_no_wrong_targets():
    """What leaps for single rows often is the motion."""
    rng = np.random.default_rng(3)
    target = 0.2 * np.sign(rng.standard_normal(400)).repeat(3)[:, None]
    angle = np.zeros_like(target)
    for row in range(1, len(target)):
        angle[row] = angle[row - 1] + 0.1 * (target[row - 1] - angle[row - 1])
    assert not [one for one in examine(log(target, angle)) if one.check == "single readings"]


def test_a_servo_that_rests_may_keep_a_speed_in_its_register():
    """Where it goes on from where it was, nothing was repeated."""
    target = 0.5 * np.sin(2 * np.minimum(TIME, 6.0))[:, None]
    position = rounded(0.97 * np.roll(target, 4, 0))
    speed = np.where(TIME > 6.2, 0.153, np.gradient(position[:, 0], TIME))[:, None]
    target[1100:] += 0.2 * (TIME[1100:, None] - 11)
    position[1104:] += 0.2 * (TIME[1100:1196, None] - 11)
    found = examine(log(target, position, joint__velocity=speed))
    assert not [one for one in found if one.check == "repeated rows"]


def test_a_gain_that_is_too_large_is_named():
    """Currents of gain times error, by a gain of a hundredth of what is said."""
    gain = np.full(TARGET.shape, 500.0 / 100)
    found = examine(log(TARGET, POSITION, command__p_gain=10 * gain, joint__current=0.5 * gain * (TARGET - POSITION)))
    assert any("as if p_gain were 20 times its value" in one.problem for one in found)


@pytest.mark.skipif(not SERVO_BENCH.is_dir(), reason=f"no recordings in {SERVO_BENCH}")
def test_benches_of_real_servos_let_nothing_go():
    """Servos that creep, saturate and rest between steps."""
    paths = [path for kind in sorted(SERVO_BENCH.iterdir()) if kind.is_dir() for path in expand(kind)[::8]]
    found = [one for path in paths for log in read_episodes(path, check=False) for one in examine(log)]
    assert not [
        one.error(None) for one in found if one.check in ("torque lost", "constant offset", "supply and temperature")
    ]


@pytest.mark.parametrize(("measured", "severity"), [(True, ""), (False, "warning")])
def test_soft_joints_that_stand_where_another_s_command_is_are_not_swapped(measured, severity):
    """On the feet of a robot the weight displaces them, and the current of each is that of its own error; a log without
    currents is not refused."""
    sways = 0.02 * np.sin(2 * TIME[:, None] + np.arange(4))
    position, target = sways + np.array([1.1, 0.5, 0.2, -0.3]), sways + np.array([0.6, 1.0, 0.2, -0.3])
    gain = np.full(target.shape, 1.0)
    current = {"command__p_gain": gain, "joint__current": rounded(target) - rounded(position)} if measured else {}
    found = [one for one in examine(log(target, position, mount="floor", **current)) if "swapped" in one.problem]
    assert {one.severity for one in found} == {severity} - {""}
