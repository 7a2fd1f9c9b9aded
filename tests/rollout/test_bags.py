"""Bags of ROS as people have them: clocks of simulations, trajectories, arrays, two publishers, leaders."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from op3.rollout import LogError, Rollout, read_log

rosbag2, typesys = (pytest.importorskip(f"rosbags.{name}") for name in ("rosbag2", "typesys"))
STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

STATE, ARRAY = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
NUMBER = "std_msgs/msg/Float64"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
JOINTS = ("a", "b", "c")
BEGIN = 1.7e9
TIME = np.arange(0, 8, 0.02)
COUNT = 2 * np.pi / 4096

Sent = tuple[str, str, float, Any]
"""Topic, type, time in the bag [s] and content of a message."""


def target(time: np.ndarray | float) -> np.ndarray:
    """Targets [time, joint]."""
    time = np.atleast_1d(time)
    return np.stack([0.5 * np.sin(2 * time), 0.3 + 0.4 * np.cos(1.7 * time), 0.3 * np.sin(1.1 * time) - 0.2], axis=1)


POSITION = np.round((0.97 * target(TIME - 0.04) + 0.005) / COUNT) * COUNT


def made(kind: str, **fields: Any) -> Any:
    """A message."""
    return STORE.types[kind](**fields)


def stamp(seconds: float, kind: str = "Time") -> Any:
    """A time or a duration."""
    return made(f"builtin_interfaces/msg/{kind}", sec=int(seconds), nanosec=round((seconds % 1) * 1e9))


def head(seconds: float) -> Any:
    """A header; 0 means now."""
    return made("std_msgs/msg/Header", stamp=stamp(seconds), frame_id="")


def state(seconds: float, angles: Iterable[float], joints: Iterable[str] = JOINTS) -> Any:
    """Positions of joints."""
    none = np.zeros(0)
    return made(STATE, header=head(seconds), name=list(joints), position=np.array(angles), velocity=none, effort=none)


def array(numbers: Iterable[float]) -> Any:
    """Numbers without names."""
    layout = made("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return made(ARRAY, layout=layout, data=np.array(numbers, dtype=float))


def trajectory(times: Iterable[float], goals: Iterable[Iterable[float]]) -> Any:
    """Points at times from now on."""
    none, kind = np.zeros(0), "trajectory_msgs/msg/JointTrajectoryPoint"
    points = [
        made(
            kind,
            positions=np.array(goal),
            velocities=none,
            accelerations=none,
            effort=none,
            time_from_start=stamp(after, "Duration"),
        )
        for after, goal in zip(times, goals, strict=True)
    ]
    return made(TRAJECTORY, header=head(0), joint_names=list(JOINTS), points=points)


def read(folder: Path, *sent: Iterable[Sent]) -> Rollout:
    """The log of a bag of these messages."""
    path, lines = folder / "bag", {}
    with rosbag2.Writer(path, version=9) as out:
        for topic, kind, time, message in sorted((one for part in sent for one in part), key=lambda one: one[2]):
            line = lines.get(topic) or lines.setdefault(topic, out.add_connection(topic, kind, typestore=STORE))
            out.write(line, round(time * 1e9), STORE.serialize_cdr(message, kind))
    return read_log(path)


def states(
    topic: str = "/joint_states",
    speed: float = 1.0,
    ahead: float = 0.0,
    angles: np.ndarray = POSITION,
    joints: Iterable[str] = JOINTS,
) -> list[Sent]:
    """States; headers run at another speed than the bag, and ahead of it."""
    return [
        (topic, STATE, BEGIN + t / speed, state(BEGIN + t + ahead, q, joints))
        for t, q in zip(TIME, angles, strict=True)
    ]


def commands(order: list[int], speed: float = 1.0) -> list[Sent]:
    """Arrays of the joints' targets in an order."""
    return [("/arm/commands", ARRAY, BEGIN + t / speed, array(target(t)[0][order])) for t in TIME]


def named_commands() -> list[Sent]:
    """Trajectories of one point, which is due at once."""
    return [("/arm/joint_trajectory", TRAJECTORY, BEGIN + t, trajectory([0.0], target(t))) for t in TIME]


def test_numbers_go_by_the_names_of_their_message(tmp_path):
    """Joints may come in another order now and then."""
    ways = np.where(np.arange(len(TIME)) // 3 % 2, -1, 1)
    sent = [
        ("/joint_states", STATE, BEGIN + t, state(BEGIN + t, q[::way], JOINTS[::way]))
        for t, q, way in zip(TIME, POSITION, ways, strict=True)
    ]
    log = read(tmp_path, sent, named_commands())
    assert log.joints == JOINTS
    assert np.array_equal(log.array("joint/position"), POSITION[: log.rows])


def test_commands_without_the_namespace_of_the_states_are_of_the_same_joints(tmp_path):
    """A namespace becomes a part of the name."""
    log = read(tmp_path, states(joints=[f"arm/{joint}" for joint in JOINTS]), named_commands())
    assert log.joints == tuple(f"arm_{joint}" for joint in JOINTS)
    assert np.abs(log.array("command/position") - target(log.array("time")[:, 0])).max() < 0.03


@pytest.mark.parametrize("count", [3, 1])
def test_a_relay_changes_nothing(tmp_path, count):
    """Of all joints, or of one."""
    relay = states("/relay/joint_states", angles=POSITION[:, :count], joints=JOINTS[:count])
    log = read(tmp_path, states(), relay, named_commands())
    assert np.array_equal(log.array("joint/position"), POSITION[: log.rows])


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (states("/r/joint_states", angles=POSITION + 0.1), "both contain this column, with different values"),
        (
            states("/r/joint_states", joints=("a", "a", "b")),
            "contains the joint a twice in one message; publish every joint under a unique",
        ),
    ],
)
def test_two_robots_and_two_joints_of_a_name_are_refused(tmp_path, other, said):
    """Which of both is meant cannot be known."""
    with pytest.raises(LogError, match=said):
        read(tmp_path, states(), other, named_commands())


def test_states_that_nobody_commands_are_refused(tmp_path):
    """With the names on both sides."""
    with pytest.raises(LogError, match=r"none of the columns a.target, b.target, c.target belongs to x, y, z"):
        read(tmp_path, states(joints=("x", "y", "z")), named_commands())


@pytest.mark.parametrize("speed", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("ahead", [0.0, -1000.0])
def test_the_clock_of_a_simulation_is_that_of_its_headers(tmp_path, speed, ahead):
    """However fast it ran; commands without a header are put on it."""
    log = read(tmp_path, states(speed=speed, ahead=ahead), commands([0, 1, 2], speed))
    assert log.duration == pytest.approx(TIME[-1], abs=0.05)
    assert np.abs(log.array("command/position") - target(log.array("time")[:, 0])).max() < 0.03
    assert log.findings == ()


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 0]])
def test_arrays_belong_to_the_joints_that_follow_them(tmp_path, order):
    """In any order, also of some of the joints; another than the states' is told."""
    log = read(tmp_path, states(), commands(order))
    assert set(log.joints) == {JOINTS[at] for at in order}
    columns = [JOINTS.index(joint) for joint in log.joints]
    assert np.abs(log.array("command/position") - target(log.array("time")[:, 0])[:, columns]).max() < 0.03
    assert ["order of joints"] * (order != [0, 1, 2]) == [one.check for one in log.findings]


@pytest.mark.parametrize("name", ["/arm/{}_controller/command", "/motor_{number}/command"])
def test_a_topic_for_each_joint_is_of_the_joint_that_it_names_or_that_follows_it(tmp_path, name):
    """As controllers of ROS 1 have them; joints that pass 0 have no second publisher."""
    sent = [
        (name.format(joint, number=7 - at), NUMBER, BEGIN + t, made(NUMBER, data=float(target(t)[0, at])))
        for at, joint in enumerate(JOINTS)
        for t in TIME
    ]
    alone = [(f"/{joint}/joint_states", STATE, joint, at) for at, joint in enumerate(JOINTS)]
    told = [
        (topic, kind, BEGIN + t, state(BEGIN + t, [angle], [joint]))
        for topic, kind, joint, at in alone
        for t, angle in zip(TIME, np.round(POSITION[:, at], 1), strict=True)
    ]
    log = read(tmp_path, told, sent)
    columns = [JOINTS.index(joint) for joint in log.joints]
    assert np.abs(log.array("command/position") - target(log.array("time")[:, 0])[:, columns]).max() < 0.03
    assert "two publishers" not in [one.check for one in log.findings]


def test_arrays_that_no_joint_follows_are_refused(tmp_path):
    """Numbers of something else."""
    rng = np.random.default_rng(0)
    noise = [("/arm/commands", ARRAY, BEGIN + t, array(2 * rng.random(3))) for t in TIME]
    with pytest.raises(
        LogError, match="sends arrays without joint names, and number 1 does not clearly belong to a joint"
    ):
        read(tmp_path, states(), noise)


def test_a_trajectory_begins_where_the_joint_is_and_ends_where_the_next_begins(tmp_path):
    """Points with a time are reached then, along a straight line; one that comes early replaces the rest."""
    goals = [(0.5, 1.0, [0.3, 0.2, 0.1]), (1.0, 1.0, [-0.3, 0.5, 0.0]), (3.0, 0.8, [0.2, 0.2, 0.2])]
    told = np.tile(POSITION[0], (len(TIME), 1))
    for begin, taken, goal in goals:
        first = told[np.searchsorted(TIME, begin)]
        share = np.clip((TIME - begin) / taken, 0, 1)[:, None]
        told = np.where((begin <= TIME)[:, None], first + share * (np.array(goal) - first), told)
    angles = np.round(told[np.maximum(np.arange(len(TIME)) - 2, 0)] / COUNT) * COUNT
    sent = [("/arm/joint_trajectory", TRAJECTORY, BEGIN + at, trajectory([after], [goal])) for at, after, goal in goals]
    log = read(tmp_path, states(angles=angles), sent)
    rows = np.searchsorted(TIME, log.array("time")[:, 0] - 1e-6)
    assert log.rows > 150
    assert np.abs(log.array("command/position") - told[rows]).max() < 0.02


@pytest.mark.parametrize("points", [1, 3])
def test_trajectories_that_replace_each_other_at_their_points_are_one_path(tmp_path, points):
    """As of a node that sends the next points in time, so that one ends at the instant at which the next begins."""
    sent = [
        ("/arm/joint_trajectory", TRAJECTORY, BEGIN + at, trajectory(after, target(at + after)))
        for at, after in ((0.2 * number, 0.2 * np.arange(1, points + 1)) for number in range(36))
    ]
    log = read(tmp_path, states(), sent)
    time = log.array("time")[:, 0]
    told = np.stack([np.interp(time, 0.2 * np.arange(40), goal) for goal in target(0.2 * np.arange(40)).T], axis=1)
    assert log.rows > 350
    assert np.abs(log.array("command/position") - told)[(time > 0.2) & (time < 7.1)].max() < 0.01


def test_arrays_of_two_controllers_are_of_different_joints(tmp_path):
    """Whatever their names; of the same joints they are refused."""
    gripper = [("/gripper/commands", ARRAY, BEGIN + t, array(target(t)[0][[1]])) for t in TIME]
    log = read(tmp_path, states(), commands([0, 2]), gripper)
    assert set(log.joints) == set(JOINTS)
    columns = [JOINTS.index(joint) for joint in log.joints]
    assert np.abs(log.array("command/position") - target(log.array("time")[:, 0])[:, columns]).max() < 0.03
    (tmp_path / "other").mkdir()
    filtered = [("/filtered/commands", ARRAY, BEGIN + t, array(0.9 * target(t)[0])) for t in TIME]
    with pytest.raises(LogError, match="both contain this column, with different values; keep one of the topics"):
        read(tmp_path / "other", states(), commands([0, 1, 2]), filtered)


@pytest.mark.parametrize(("angle", "said"), [(0.0, "are ignored"), (0.4, "stop one of the programs")])
def test_two_publishers_of_commands_are_found(tmp_path, angle, said):
    """Zeros are left out, another pose is refused; levels that are told in turn are one publisher's."""
    second = [("/arm/commands", ARRAY, BEGIN + t + 0.007, array([angle] * 3)) for t in TIME[5::5]]
    try:
        (found,) = read(tmp_path, states(), commands([0, 1, 2]), second).findings
        problem = f"{found.problem}; {found.remedy}"
    except LogError as error:
        problem = str(error)
    assert "two programs publish the topic" in problem
    assert said in problem
    (tmp_path / "levels").mkdir()
    levels = np.outer(np.sign(np.sin(6 * TIME) + 1e-9), [0.3, 0.2, 0.25])
    angles = np.stack([levels[max(row - 5, 0) : row + 1].mean(0) for row in range(len(TIME))])
    sent = [("/arm/commands", ARRAY, BEGIN + t, array(goal)) for t, goal in zip(TIME, levels, strict=True)]
    assert np.array_equal(read(tmp_path / "levels", states(angles=angles), sent).array("command/position"), levels)


def test_zeros_of_a_second_publisher_are_left_out(tmp_path):
    """And said; one that sends other numbers is refused."""

    def second(angle: float) -> list[Sent]:
        return [("/joint_states", STATE, BEGIN + t + 0.011, state(BEGIN + t + 0.011, [angle] * 3)) for t in TIME[5::3]]

    log = read(tmp_path, states(), second(0.0), commands([0, 1, 2]))
    assert np.array_equal(log.array("joint/position"), POSITION[: log.rows])
    assert [one.check for one in log.findings] == ["two publishers"]
    (tmp_path / "other").mkdir()
    with pytest.raises(LogError, match=r"of /joint_states differ strongly from those before and after: two"):
        read(tmp_path / "other", states(), second(1.2), commands([0, 1, 2]))


@pytest.mark.parametrize(("leader", "follower"), [("/leader", "/follower"), ("/master_left", "/puppet_left")])
def test_states_of_a_leader_are_commands(tmp_path, leader, follower):
    """Of the arm that follows it."""
    log = read(tmp_path, states(f"{leader}/joint_states", angles=target(TIME)), states(f"{follower}/joint_states"))
    assert np.array_equal(log.array("joint/position"), POSITION)
    assert np.abs(log.array("command/position") - target(TIME)).max() < 0.03


def test_a_leader_s_joints_are_those_of_its_follower(tmp_path):
    """Whose names begin with which arm they are of."""
    arms = [
        (f"/{arm}_arm/joint_states", STATE, BEGIN + t, state(BEGIN + t, angle, [f"{arm}_{joint}" for joint in JOINTS]))
        for arm, angles in (("leader", target(TIME)), ("follower", POSITION))
        for t, angle in zip(TIME, angles, strict=True)
    ]
    log = read(tmp_path, arms)
    assert log.joints == tuple(f"follower_{joint}" for joint in JOINTS)
    assert np.abs(log.array("command/position") - target(TIME)).max() < 0.03
