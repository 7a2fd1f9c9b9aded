"""Start checks, and switching torque on in the only order that is safe."""

import re

import numpy as np
import pytest
from deploy_rig import make_rig

from op3.deploy import start_checks
from op3.deploy.emulator import USUAL_SETTINGS, BrownOut, Faults, FrozenImu, LineTiming, Overheat, Silent
from op3.deploy.exit_codes import ExitCode
from op3.deploy.operator import Operator
from op3.deploy.phases import GainRamp, HoldPose
from op3.deploy.protocol import Error, Instruction
from op3.deploy.registers import DYNAMIXEL_X, HardwareError
from op3.robot import pose
from op3.rollout import Rollout
from tests.op3_table import IS_LEG, SERVO_IDS, indices


def put(joint, register, value, at=0.0):
    """What another program left in a servo; at a time, where booting clears the register."""
    return dict(prepare=lambda robot: robot.at(at, lambda: robot.servos[joint].put(register, value)))


def lean(robot):
    robot.physics.tilt_from = 0.0


def outside(robot):
    robot.physics.position[indices(["l_knee"])] = 2.4


def overloaded(robot):
    robot.at(0.3, lambda: robot.servos["r_knee"].fail(HardwareError.OVERLOAD))


FAILURES = {
    "homing": (
        put("l_knee", "homing_offset", 150),
        r"homing offset: unexpected values: l_knee 150 \(up to \+0.23 rad\), set by .*limits.homing_offset=150",
    ),
    "pwm": (put("l_knee", "pwm_limit", 400), "pwm limit: unexpected values: l_knee 400; .*mode=setup"),
    "profile": (put("l_knee", "profile_velocity", 30, at=0.3), "profile velocity: unexpected values: l_knee 30"),
    "shutdown": (put("l_knee", "shutdown", 0), "shutdown: unexpected values: l_knee 0; .*mode=setup"),
    "latency timer": (
        dict(timing=LineTiming(latency_timer=0.016)),
        r"servo power: answers come after 16 ms: .*latency timer.*echo 1 .*latency_timer, or setserial",
    ),
    "latency timer of 8 ms": (dict(timing=LineTiming(latency_timer=0.008)), "answers come after 8 ms: .*latency timer"),
    "latency timer of 4 ms": (dict(timing=LineTiming(latency_timer=0.004)), "answers come after 4 ms: .*latency timer"),
    "protocol": (
        put("l_knee", "protocol_version", 1),
        r"ping: protocol 1.0 answer from l_knee \(id 14\); set their register protocol_version to 2",
    ),
    "return level": (
        put("l_el", "status_return_level", 1, at=0.4),
        "status return level: l_el do not answer every packet",
    ),
    "drive": (put("l_el", "drive_mode", 1), "drive mode: unexpected values: l_el 1; write it once with mode=setup"),
    "cool": (
        put("l_el", "temperature_limit", 70),
        "servo limits: l_el 70 C: a servo would shut down before the run ends at 72 C",
    ),
    "min voltage": (put("l_el", "min_voltage_limit", 105), "servo limits: l_el 10.5 V: a servo would report an error"),
    "warm": (
        dict(faults=Faults(scheduled=(Overheat(SERVO_IDS["l_el"], 0.0, 80.0),))),
        r"temperature: \d+ C at l_el, the highest; let it cool",
    ),
    "silent": (dict(faults=Faults(scheduled=(Silent(14),))), r"ping: no answer from l_knee \(id 14\)"),
    "opencr": (dict(faults=Faults(scheduled=(Silent(200),))), r"servo power: opencr \(id 200\) did not answer"),
    "model": (put("l_el", "model_number", 1060), "l_el is model 1060, expected 1020"),
    "firmware": (put("l_el", "firmware_version", 30), "without bus watchdog: l_el 30"),
    "delay": (dict(settings={**USUAL_SETTINGS, "return_delay_time": 250}), "return delay: too long: head_pan 500 us"),
    "error": (dict(prepare=overloaded), r"hardware errors: r_knee \(overload\)"),
    "voltage": (dict(faults=Faults(scheduled=(BrownOut(0.0, voltage=10.2),))), "10.2 V at .* charge to at least 10.5"),
    "angle": (dict(prepare=outside), "l_knee is at 2.40 rad, outside its soft limits"),
    "frozen": (dict(faults=Faults(scheduled=(FrozenImu(0.0),))), "IMU: 25 readings contain only 1 different block"),
    "tilted": (dict(prepare=lean), "IMU: roll 60 deg.* put the robot upright"),
}


@pytest.mark.parametrize("failure", sorted(FAILURES))
def test_a_failed_check_energises_nothing(tmp_path, failure):
    """Each failing start check ends the run with its exit code and reason, and no torque was ever switched on."""
    options, reason = FAILURES[failure]
    rig = make_rig(tmp_path, **options)
    outcome = rig.run()
    assert outcome.code == ExitCode.START_CHECK
    assert outcome.release is None
    assert re.search(reason, outcome.reason), outcome.reason
    assert rig.written("torque_enable") == []
    assert rig.written("goal_current") == []
    assert not any(rig.register("torque_enable"))


def no_more_answers(robot):
    """Everything is silent from the moment in which a servo is told what its block is made of."""
    servo = robot.servos["l_knee"]
    write_bytes = servo._write_bytes

    def fall_silent(targets, data):
        robot._silent.update(dict.fromkeys(SERVO_IDS.values(), robot._heard))
        return write_bytes(targets, data)

    servo._write_bytes = fall_silent


def pulled_plug(robot):
    """The plug is pulled at that moment."""
    servo = robot.servos["l_knee"]
    servo._write_bytes = lambda targets, data: setattr(robot, "unplugged", True) or 0


@pytest.mark.parametrize("what", [no_more_answers, pulled_plug])
def test_a_bus_that_fails_between_checks_and_torque(tmp_path, what):
    """Nothing has been energised, and the exit code says so."""
    rig = make_rig(tmp_path, prepare=what)
    outcome = rig.run()
    assert outcome.code == ExitCode.START_CHECK
    assert outcome.release is None
    assert not any(rig.register("torque_enable"))
    assert rig.lines[-1].startswith("start_check (10)")


@pytest.fixture
def timer(tmp_path, monkeypatch):
    """The file in which the kernel shows the latency timer of the rig's adapter."""
    monkeypatch.setattr(start_checks, "ADAPTERS", tmp_path / "sys")
    (tmp_path / "sys" / "virtual").mkdir(parents=True)
    return tmp_path / "sys" / "virtual" / "latency_timer"


def test_the_latency_timer_comes_first(tmp_path, timer):
    """An adapter at 16 ms is refused with the command that mends it, before a byte is sent."""
    timer.write_text("16\n")
    rig = make_rig(tmp_path)
    outcome = rig.run()
    assert outcome.code == ExitCode.START_CHECK
    assert f"echo 1 | sudo tee {timer}" in outcome.reason
    assert rig.packets() == []


def test_the_checks_pass_at_1_ms_and_are_all_told(tmp_path, timer):
    """With the timer at 1 ms all checks pass, in their order."""
    timer.write_text("1\n")
    rig = make_rig(tmp_path)
    assert rig.run(duration=0.1).code == ExitCode.OK
    told = [line.split(":")[0].removeprefix("ok").strip() for line in rig.lines if line.startswith("ok  ")]
    assert told == [
        *("latency timer", "servo power", "ping", "models and firmware", "return delay"),
        *(
            "status return level",
            "drive mode",
            "homing offset",
            "pwm limit",
            "profile velocity",
            "profile acceleration",
            "shutdown",
        ),
        *("servo limits", "hardware errors", "temperature"),
        *("supply voltage", "joint angles", "self-collision", "IMU"),
    ]


def test_not_confirmed(tmp_path, monkeypatch):
    """An operator who does not say yes ends the run before torque."""
    monkeypatch.setattr(Operator, "confirm", lambda self, text: False)
    rig = make_rig(tmp_path)
    assert rig.run().code == ExitCode.DECLINED
    assert rig.written("torque_enable") == []


def test_order_of_switching_on(tmp_path):
    """On the wire: mode, current limit, goal current 0 and its reading back, torque, watchdog - in this order."""
    rig = make_rig(tmp_path)
    rig.run(duration=0.1)
    addresses = {64: "torque", 11: "mode", 38: "limit", 102: "goal", 98: "watchdog"}
    events = []
    for _, packet in rig.packets():
        address = int.from_bytes(packet.parameters[:2], "little")
        if packet.instruction == Instruction.SYNC_WRITE and address in addresses:
            events.append(f"write {addresses[address]}")
        elif packet.instruction == Instruction.SYNC_READ and address in addresses:
            events.append(f"read {addresses[address]}")
    # torque and watchdog are off already and read so; what differs is written and read back
    assert events[:12] == [
        *("read torque", "read watchdog"),
        *("read mode", "write mode", "read mode"),
        *("read limit", "write limit", "read limit"),
        *("write goal", "read goal"),
        *("read torque", "write torque"),
    ]
    assert events[12:15] == ["read torque", "read watchdog", "write watchdog"]


def test_no_current_flows_when_torque_comes_on(tmp_path):
    """At the moment torque is enabled every goal current is 0, though the mode change had set it to the limit."""
    rig = make_rig(tmp_path)
    seen = []
    for servo in rig.robot.servos.values():
        written = servo.written

        def spy(register, value, servo=servo, written=written):
            if register.name == "torque_enable" and value == 1:
                seen.append(servo.get("goal_current"))
            if register.name == "operating_mode":
                seen.append("mode")
            written(register, value)

        servo.written = spy
    rig.run(duration=0.1)
    assert seen.count("mode") == 20
    assert [value for value in seen if value != "mode"] == [0] * 20


def test_settings_in_the_servos(tmp_path):
    """While it runs: current mode, limits 855 and 430, watchdog 5 (100 ms), torque on all twenty."""
    rig = make_rig(tmp_path)
    found = {}

    def look():
        for name in ("operating_mode", "current_limit", "bus_watchdog", "torque_enable"):
            found[name] = rig.register(name)
        return True

    rig.run([GainRamp(), HoldPose(pose("stand", "op3"), until=look)])
    assert found["operating_mode"] == [0] * 20
    assert found["current_limit"] == np.where(IS_LEG, 855, 430).tolist()
    assert found["bus_watchdog"] == [5] * 20
    assert found["torque_enable"] == [1] * 20


def test_eeprom_is_not_worn(tmp_path):
    """A second run writes no EEPROM register that has its value already, but for nothing at all."""
    rig = make_rig(tmp_path)
    assert rig.run(duration=0.1).code == ExitCode.OK
    before = len(rig.packets())
    rig.bus._writer = None
    assert rig.run(duration=0.1).code == ExitCode.OK
    later = rig.packets()[before:]
    writes = {int.from_bytes(p.parameters[:2], "little") for _, p in later if p.instruction == Instruction.SYNC_WRITE}
    assert writes.isdisjoint({11, 38})


def test_a_goal_that_cannot_be_set_stops_before_torque(tmp_path):
    """If one servo keeps another goal current than 0, nothing is energised and it is named."""

    def stubborn(robot):
        servo = robot.servos["l_knee"]
        write, goal = servo.write, DYNAMIXEL_X["goal_current"].address
        servo.write = lambda address, data: Error.DATA_RANGE if address == goal else write(address, data)

    rig = make_rig(tmp_path, prepare=stubborn)
    outcome = rig.run()
    assert outcome.code == ExitCode.ENERGISE
    assert "goal_current could not be set on l_knee (1193)" in outcome.reason
    assert all(value == 0 for _, values in rig.written("torque_enable") for value in values.values())
    assert outcome.release is not None
    assert outcome.release.ok


def test_a_tripped_watchdog_of_an_earlier_run_is_cleared(tmp_path):
    """Servos whose watchdog has tripped have read-only goals; the start clears it and runs."""
    rig = make_rig(tmp_path)

    def trip():
        for servo in rig.robot.servos.values():
            servo.trip()

    rig.robot.at(0.55, trip)
    assert rig.run(duration=0.1).code == ExitCode.OK


def test_the_ramp_begins_softly(tmp_path):
    """The current starts at almost nothing, the P gain reaches full after a good second; no goal jumps by over 3 %."""
    rig = make_rig(tmp_path)
    rig.run(duration=0.5, folder=tmp_path / "logs")
    log = Rollout.load(tmp_path / "logs" / "approach")
    gain = log.array("command/p_gain")[:, 0]
    assert gain[0] == 0
    assert gain[124] == pytest.approx(6 * 124 / 125)
    assert np.diff(gain).min() >= 0
    assert gain[160:].min() == 6
    assert np.abs(log.array("raw/goal_current")[0]).max() < 10
    assert np.abs(np.diff(log.array("raw/goal_current"), axis=0)).max() <= 0.03 * 855


def test_a_long_move_is_slowed(tmp_path):
    """A long move is slowed to 1 rad/s and ends where it should, without a corner."""
    rig = make_rig(tmp_path, position=pose("zero", "op3"))
    rig.run(duration=0.4, folder=tmp_path / "logs")
    log = Rollout.load(tmp_path / "logs" / "approach")
    target = log.array("command/position")
    moving = np.flatnonzero(np.abs(np.diff(target, axis=0)).max(1) > 0)
    # the knee goes 1.13 rad: 1.875 x 1.13 s = 2.12 s at 1 rad/s
    assert (moving[-1] - moving[0] + 2) * 0.008 == pytest.approx(2.12, abs=0.1)
    assert np.abs(np.diff(target, axis=0)).max() / 0.008 <= 1.01
    assert np.allclose(target[-1], pose("stand", "op3"))
