"""The loop as the wire sees it: when a tick speaks, in which order, and what its currents are made of."""

import numpy as np
import pytest
from deploy_rig import NAMES, make_rig
from policies import hold_policy

from op3.deploy.emulator import read_frames
from op3.deploy.exit_codes import ExitCode
from op3.deploy.limits import Limits
from op3.deploy.phases import GainRamp, HoldPose, Move
from op3.deploy.policy_runner import FollowPolicy, PolicyRunner
from op3.deploy.protocol import Instruction, Parser, fast_answers
from op3.deploy.robot_state import CONTENTS
from op3.robot import pose
from tests.op3_table import IS_LEG, JOINTS, OP3, SERVO_IDS

KINDS = {
    (Instruction.FAST_SYNC_READ, 224): "read servos",
    (Instruction.READ, 30): "read board",
    (Instruction.SYNC_WRITE, 102): "write currents",
}


def ticks_of(rig):
    """Of each whole tick: time of its first byte, what was said in order, counts read by joint, goals written."""
    rig.robot.bus.close()
    ticks, asked = [], []
    for frame in read_frames(rig.frames_file):
        if frame.direction == "<":
            if ticks and len(ticks[-1]["said"]) == 1:
                ticks[-1]["answer"] += frame.data
            continue
        for packet in Parser().feed(frame.data):
            address = int.from_bytes(packet.parameters[:2], "little")
            kind = KINDS.get((packet.instruction, address), "other")
            if kind == "read servos":
                asked = list(packet.parameters[4:])
                ticks.append({"time": frame.time, "said": [], "answer": b"", "asked": asked})
            if not ticks:
                continue
            ticks[-1]["said"].append(kind)
            if kind == "write currents" and "goal" not in ticks[-1]:
                parts = packet.parameters[4:]
                values = {
                    NAMES[parts[i]]: int.from_bytes(parts[i + 1 : i + 3], "little", signed=True)
                    for i in range(0, 60, 3)
                }
                ticks[-1]["goal"] = np.array([values[joint] for joint in JOINTS])
    return [tick for tick in ticks if "goal" in tick]


def readings_of(tick):
    """Position [rad] and velocity [rad/s] by joint, from the bytes of a tick's answer and the manual's units."""
    answers = fast_answers(tick["answer"], tick["asked"], 14)
    kind = np.dtype([(name, entry.kind) for name, entry in CONTENTS.items()])
    rows = np.array([np.frombuffer(answers[SERVO_IDS[joint]][1], kind)[0] for joint in JOINTS])
    return (rows["position"] - 2048) * 2 * np.pi / 4096, rows["velocity"] * 0.229 * 2 * np.pi / 60


def test_every_tick_reads_all_then_writes_at_whole_multiples_of_8_ms(tmp_path):
    """On the wire a tick is: one fast sync read, one read of the board, one sync write; the next is 8.000 ms later."""
    rig = make_rig(tmp_path)
    outcome = rig.run(duration=0.5)
    ticks = ticks_of(rig)[1:-1]  # the first read belongs to the preparation, the last write to switching off
    running = [tick for tick in ticks if tick["said"][:3] == list(KINDS.values())]
    assert len(running) > 430
    times = np.array([tick["time"] for tick in running])
    assert np.abs(np.diff(times) - 0.008).max() < 2e-7
    assert all(len(tick["said"]) == 3 for tick in running[:-1])
    # how well deadlines were kept is told in one line
    assert f"{outcome.timing.ticks} ticks, 0 missed; lateness p50 0.00 ms, p99 0.00 ms, max 0.00 ms" in rig.lines


def test_goal_currents_are_the_pd_of_the_bytes_just_read(tmp_path):
    """Kp (q* - q) - Kd dq in units of 2.69 mA, from the counts in the same tick's answer, servo by servo."""
    rig = make_rig(tmp_path)
    outcome = rig.run(
        [GainRamp(), FollowPolicy(PolicyRunner(hold_policy(feedback=0.05), robot="op3"), 1.0)], folder=tmp_path / "logs"
    )
    log = outcome.logs["run"]
    target, kp, kd = (log.array(f"command/{name}") for name in ("position", "p_gain", "d_gain"))
    written, compared = ticks_of(rig), 0
    goals = [tick["goal"].tolist() for tick in written]
    first = goals.index(log.array("raw/goal_current")[0].astype(int).tolist())
    for row, tick in enumerate(written[first : first + log.rows]):
        position, velocity = readings_of(tick)
        current = kp[row] * (target[row] - position) - kd[row] * velocity
        counts = np.clip(current / 0.00269, -Limits().currents(OP3)[0], Limits().currents(OP3)[0])
        assert np.abs(tick["goal"] - counts).max() <= 0.5 + 1e-6
        compared += 1
    assert compared == log.rows == 124
    # the targets, and so the policy, change with every fourth of these ticks and with no other
    changed = np.flatnonzero(np.abs(np.diff(target, axis=0)).max(1) > 0) + 1
    assert len(changed) > 20
    assert (changed % 4 == 0).all()


def blocked(rig):
    """Joints that do not move whatever flows, as against a stop."""

    def drive(enabled, current):
        rig.physics._current = np.where(enabled, current, 0.0)

    rig.physics.drive = drive
    return rig


ANY_POSE = Limits(overlap_ahead=1.0)
"""Lets a robot be commanded to where its legs would hit each other: here the joints never move."""


def far():
    target = pose("stand", "op3")
    target[:] = np.where(target > 0, target - 0.9, target + 0.9)
    return target


def test_currents_on_the_wire_stay_within_peak_and_continuous(tmp_path):
    """Against a stop: never more than 855 counts in a leg and 430 elsewhere, and after seconds down towards 171."""
    rig = blocked(make_rig(tmp_path))
    assert rig.run([GainRamp(), HoldPose(far(), duration=5.0)], limits=ANY_POSE).code == ExitCode.OK
    goals = np.abs([tick["goal"] for tick in ticks_of(rig)])
    assert goals[:, IS_LEG].max() == 855
    assert goals[:, ~IS_LEG].max() == 430
    last = goals[-5]
    assert ((last >= 171) & (last < 230))[IS_LEG].all()


def test_stiffness_comes_back_slowly_after_a_soft_phase(tmp_path):
    """A move behind a soft hold begins with its command: against a stop the currents rise step by step."""
    rig, near = blocked(make_rig(tmp_path)), pose("stand", "op3") + 0.1

    def phases(session):
        return [GainRamp(1.0), HoldPose(near, 1.0, duration=0.5), Move(near, start=lambda: session.issued)]

    assert rig.run(phases).code == ExitCode.OK
    goals = np.abs([tick["goal"] for tick in ticks_of(rig)])
    assert goals.max() > 200
    assert np.diff(goals[200:-2], axis=0).max() < 12  # 0.1 rad times 5 A/rad in 0.25 s, in counts per tick: 6


@pytest.mark.parametrize("scale", [0.5, 0.1])
def test_no_current_is_above_the_scale(tmp_path, scale):
    """A suspended robot gets a share of the peak currents: in the servos' own limit and on the wire."""
    rig, found = blocked(make_rig(tmp_path)), []
    peak = np.floor(scale * np.where(IS_LEG, 855, 430))

    def look():
        found.append(rig.register("current_limit"))
        return len(found) > 100

    hold = HoldPose(far(), until=look)
    assert rig.run([GainRamp(), hold], current_scale=scale, limits=ANY_POSE).code == ExitCode.OK
    assert found[0] == peak.tolist()
    assert np.abs([tick["goal"] for tick in ticks_of(rig)]).max(0).tolist() == peak.tolist()
