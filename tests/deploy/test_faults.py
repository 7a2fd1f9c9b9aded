"""What happens to the robot when something goes wrong: coast, damp, off, and the exit code that says so."""

import numpy as np
import pytest
from deploy_rig import make_rig

from op3.deploy.emulator import BrownOut, Faults, FrozenImu, HardwareFault, LineTiming, Overheat, Silent, Unplug
from op3.deploy.exit_codes import ExitCode
from op3.deploy.limits import Command, CurrentLimiter, Limits
from op3.deploy.phases import GainRamp, HoldPose
from op3.deploy.registers import HardwareError
from op3.robot import pose
from op3.rollout import Rollout
from tests.op3_table import HIGH, JOINTS, LOW, OP3, SERVO_IDS, indices

KNEE, START = SERVO_IDS["l_knee"], 3.0
"""The servo that goes wrong, and when [s]; torque comes on at about 0.9 s."""

PHASES = (GainRamp, lambda: HoldPose(pose("stand", "op3"), duration=4.0, log="run"))


def faulty(tmp_path, *scheduled, **rates):
    return make_rig(tmp_path, faults=Faults(scheduled=scheduled, **rates))


def go(rig, **options):
    return rig.run([make() for make in PHASES], **options)


def goals(rig, joint="l_knee", start=START - 0.05, end=START + 0.25):
    """Times and values of a joint's goal currents on the wire."""
    found = [(time, values[joint]) for time, values in rig.written("goal_current") if start < time < end]
    return np.array([time for time, _ in found]), np.array([value for _, value in found])


def assert_released(rig, outcome):
    assert outcome.release is not None
    assert outcome.release.ok
    assert rig.register("torque_enable") == [0] * 20
    assert "torque off verified 20/20" in rig.lines


def assert_damped(rig, off):
    """For half a second before torque off no joint is stiff: holding needs 62 counts, braking a sinking one 29."""
    for joint in ("l_knee", "r_ank_pitch"):
        before = goals(rig, joint, off - 0.9, off - 0.7)[1] if off > START + 1.0 else goals(rig, joint, 2.8, 2.95)[1]
        assert np.abs(before).min() > 30
        times, values = goals(rig, joint, off - 0.48, off - 0.001)
        assert len(times) > 50
        assert np.abs(values).max() <= 31


def torque_off(rig):
    """When torque off was sent first after the fault [s]."""
    return next(t for t, values in rig.written("torque_enable") if t > START - 1 and not any(values.values()))


@pytest.mark.parametrize("device", [200, KNEE])
def test_a_short_silence_is_coasted(tmp_path, device):
    """Three lost ticks: the silent servo's goal is repeated, the others go on, and the run ends as asked."""
    rig = faulty(tmp_path, Silent(device, START, START + 0.02))
    outcome = go(rig)
    assert outcome.code == ExitCode.OK
    times, values = goals(rig)
    if device == KNEE:
        repeated = values[(times > START + 0.006) & (times < START + 0.024)]
        assert len(set(repeated.tolist())) == 1
    # nothing is damped: holding the load needs about 62 counts of the knee throughout
    assert (np.abs(values) > 50).all()
    assert np.diff(times).max() < 0.017


def test_coast_damp_off(tmp_path):
    """A servo that stays silent: 3 ticks its goal stands, from the 4th it gets none and the others damp, then off."""
    rig = faulty(tmp_path, Silent(KNEE, START))
    outcome = go(rig)
    assert outcome.code == ExitCode.NOT_VERIFIED  # the cable is still off: 19 of 20 can be read back
    assert "no answer from l_knee" in outcome.reason
    assert "torque off verified 19/20; NOT VERIFIED: l_knee (no answer)" in outcome.reason
    times, values = goals(rig, end=START + 0.2)
    none = int(np.flatnonzero(values == 0)[0])
    # silent in ticks 1 to 3: the last goal before stands; tick 4, 24 to 32 ms and the tick's own 6 ms after START
    assert (values[none - 3 : none] == values[none - 4]).all()
    assert values[none - 4] != 0
    assert START + 0.024 < times[none] < START + 0.040
    assert (values[none:] == 0).all()
    others = goals(rig, "r_knee", end=START + 0.2)[1]
    assert np.abs(others[none - 3 : none]).min() > 30
    assert np.abs(others[none + 1 : none + 6]).max() < 30
    assert START + 0.090 < torque_off(rig) < START + 0.112


def test_all_silent_stops_at_96_ms(tmp_path):
    """When nothing answers any more, torque off is sent 96 ms (12 ticks) after the last answer."""
    rig = faulty(tmp_path, *(Silent(number, START, START + 1.0) for number in [*SERVO_IDS.values(), 200]))
    outcome = go(rig)
    assert outcome.code == ExitCode.BUS_LOSS
    assert "no answer from anything on the bus for 12 ticks (96 ms)" in outcome.reason
    assert_released(rig, outcome)
    assert START + 0.088 < torque_off(rig) < START + 0.112


def test_the_robot_comes_back_softly_after_damping(tmp_path):
    """After six silent ticks the stiffness comes back over 0.25 s, not at once."""
    rig = faulty(tmp_path, Silent(200, START, START + 0.045))
    assert go(rig, folder=tmp_path / "logs").code == ExitCode.OK
    log = Rollout.load(tmp_path / "logs" / "run")
    gain = log.array("command/p_gain")[:, 0]
    damped = np.flatnonzero(gain == 0)
    assert 2 <= len(damped) <= 4
    after = gain[damped[-1] + 1 : damped[-1] + 35]
    assert after[0] == pytest.approx(6 * 0.008 / 0.25)
    assert (np.diff(after) >= 0).all()
    assert np.diff(after).max() < 0.25
    assert after[-1] == 6


@pytest.mark.parametrize(
    ("bit", "cause"),
    [
        (HardwareError.OVERLOAD, "overload"),
        (HardwareError.OVERHEATING, "overheating"),
        (HardwareError.ELECTRICAL_SHOCK, "electrical shock"),
    ],
)
def test_a_servo_that_shuts_down_stops_the_run_within_two_ticks(tmp_path, bit, cause):
    """It is named with its cause, and torque off is on the wire within two ticks (16 ms)."""
    rig = faulty(tmp_path, HardwareFault(KNEE, START, bit))
    outcome = go(rig)
    assert outcome.code == ExitCode.SERVO_SHUTDOWN
    assert f"shut down: l_knee ({cause})" in outcome.reason
    assert_released(rig, outcome)
    assert torque_off(rig) - START <= 0.016


def lean(rig, end=np.inf):
    """The trunk rolls by 60 deg, for a while."""
    rig.physics.tilt_from = START
    rig.robot.at(end, lambda: setattr(rig.physics, "tilt_from", np.inf))


ENDS = {
    # a servo's own limit is 80 C
    "hot": (Overheat(KNEE, 1.0, rate=14.0), ExitCode.TEMPERATURE, "l_knee is at 72 C; let it cool", None),
    # ten readings
    "low": (BrownOut(START, voltage=9.8), ExitCode.VOLTAGE, "9.8 V", 0.08),
    "at the limit": (BrownOut(START, voltage=10.0), ExitCode.VOLTAGE, "10.0 V", 0.08),
    # an input voltage error is no shutdown
    "odd": (BrownOut(START, voltage=9.0), ExitCode.VOLTAGE, "out of the voltage range: head_pan (input voltage)", None),
    # 25 blocks of 8 ms
    "frozen": (FrozenImu(START), ExitCode.IMU_FROZEN, "25 identical blocks", 0.2),
    "fallen": (None, ExitCode.FALL, "tilted by 60 deg", 0.1),
}


@pytest.mark.parametrize("end", ENDS)
def test_a_worry_damps_and_ends(tmp_path, end):
    """After the time that it takes to be sure the joints are damped for half a second, then torque goes off."""
    fault, code, reason, sure = ENDS[end]
    rig = faulty(tmp_path, *([fault] if fault else []))
    if fault is None:
        lean(rig)
    outcome = go(rig, folder=tmp_path / "logs")
    assert outcome.code == code
    assert reason in outcome.reason
    assert_released(rig, outcome)
    assert_damped(rig, torque_off(rig))
    assert sure is None or torque_off(rig) - START == pytest.approx(sure + 0.5, abs=0.03)
    after = Rollout.load(tmp_path / "logs" / "after")
    assert (after.array("command/p_gain") == 0).all()
    assert (after.array("command/d_gain") == 0.2).all()
    assert bool(Rollout.load(tmp_path / "logs" / "run").metadata.fallen) == (code == ExitCode.FALL)


def test_a_stumble_and_a_dip_end_nothing(tmp_path):
    """40 ms of low supply, and later 90 ms beyond 45 deg."""
    rig = faulty(tmp_path, BrownOut(START - 1.0, START - 0.96, voltage=9.8))
    lean(rig, START + 0.09)
    assert go(rig).code == ExitCode.OK


def test_one_servo_that_restarts_is_named(tmp_path):
    """A loose plug restarts one servo in 80 ms: it comes back without torque and is named, and all are switched off."""
    rig = faulty(tmp_path)
    servo = rig.robot.servos["l_knee"]
    rig.robot.at(START, lambda: servo.power(True, START))
    outcome = go(rig)
    assert outcome.code == ExitCode.SERVO_SHUTDOWN
    assert "restarted unexpectedly: l_knee" in outcome.reason
    assert_released(rig, outcome)


@pytest.mark.parametrize(
    ("kind", "rate"), [("lost", 0.0026), ("corrupt", 0.002), ("truncated", 0.002), ("unheard", 0.005), ("late", 0.001)]
)
def test_spoilt_packets_are_coasted(tmp_path, kind, rate):
    """At ten times the losses of the field and in every form the run goes on; no goal moves by more than the losses."""
    rig = faulty(tmp_path)
    rig.robot.at(2.0, lambda: setattr(rig.robot.bus, "faults", Faults(**{kind: rate})))
    outcome = go(rig, folder=tmp_path / "logs")
    assert outcome.code == ExitCode.OK, outcome.reason
    answered = Rollout.load(tmp_path / "logs" / "run").array("raw/answered")
    assert (answered == 0).any() or kind == "unheard"
    values = np.array([list(found.values()) for time, found in rig.written("goal_current") if 2.0 < time < 5.0])
    # a late answer, and those behind it, are missed for five ticks: from what was held to none, and softly back
    assert np.abs(np.diff(values, axis=0)).max() <= (120 if kind == "late" else 12)


def test_unplugged(tmp_path):
    """Without the port nothing can be sent: the run says so, and the watchdogs free all servos 100 ms later."""
    rig = faulty(tmp_path, Unplug(START))
    outcome = go(rig)
    assert outcome.code == ExitCode.NOT_VERIFIED
    assert "check the USB cable" in outcome.reason
    assert "NOT VERIFIED" in outcome.reason
    assert rig.register("bus_watchdog") == [-1] * 20
    assert not rig.robot.driven.any()


def test_plugged_in_again_with_the_latency_of_a_new_adapter(tmp_path):
    """A plug that was pulled comes back with a latency timer of 16 ms: answers are waited for that long."""
    rig = faulty(tmp_path, Unplug(START))

    def plug_in():
        rig.robot.unplugged = False
        rig.robot.bus.timing = LineTiming(latency_timer=0.016)

    rig.robot.at(START + 2.0, plug_in)
    outcome = go(rig)
    assert outcome.code == ExitCode.UNPLUGGED
    assert_released(rig, outcome)


@pytest.mark.parametrize("what", ["position", "p_gain", "d_gain"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_never_reaches_a_servo(tmp_path, what, value):
    """A NaN or an infinity in a target or gain ends the run, damped, and the wire never carries it."""

    class Broken:
        name, log = "broken", "run"

        def command(self, elapsed, state):
            command = Command.of(pose("stand", "op3"), 6.0, 0.1)
            if elapsed >= 5:
                getattr(command, what)[3] = value
            return command

        def channels(self):
            return {}

    rig = faulty(tmp_path)
    outcome = rig.run([GainRamp(), Broken()])
    assert outcome.code == ExitCode.NON_FINITE
    assert f"{what} of l_sho_roll" in outcome.reason
    assert_released(rig, outcome)
    assert max(abs(v) for _, values in rig.written("goal_current") for v in values.values()) < 200


def test_a_held_up_loop_is_told_from_a_running_one(tmp_path):
    """A stall of 150 ms, in which the watchdogs let go, ends the run instead of commanding servos that ignore it."""
    stalled = []

    class Stalling(HoldPose):
        def command(self, elapsed, state):
            if elapsed > 100 and not stalled:
                stalled.append(True)
                rig.robot.clock.sleep(0.15)
            return super().command(elapsed, state)

    rig = faulty(tmp_path)
    outcome = rig.run([GainRamp(), Stalling(pose("stand", "op3"), duration=2.0)])
    assert outcome.code == ExitCode.OVERRUN
    assert_released(rig, outcome)


def limiter_state(rig):
    rig.bus.writer().write("opencr", "dynamixel_power", 1)
    rig.robot.clock.sleep(0.5)
    return rig.bus.read_state()


def test_soft_limits(tmp_path):
    """Targets are clipped to the soft limits, and beyond one no current pushes further out."""
    command = Command.of(np.full(20, 5.0), 6.0, 0.1).limited(OP3)
    assert np.array_equal(command.position, HIGH)
    assert np.array_equal(Command.of(np.full(20, -5.0), 6.0, 0.1).limited(OP3).position, LOW)
    position = pose("stand", "op3")
    position[indices(["l_knee"])] = HIGH[JOINTS.index("l_knee")] + 0.02
    rig = make_rig(tmp_path, position=position)
    state = limiter_state(rig)
    # a moving joint whose damping term would push outwards
    rig.physics.velocity = np.full(20, -3.0)
    knee = JOINTS.index("l_knee")
    outwards = CurrentLimiter(Limits(), OP3, 0.008).counts(state, Command.of(state.position + 0.5, 6.0, 0.1))
    assert outwards[knee] == 0
    assert outwards[knee - 1] > 0
    back = CurrentLimiter(Limits(), OP3, 0.008).counts(state, Command.of(state.position - 0.5, 6.0, 0.1))
    assert back[knee] < 0


def test_limits_that_contradict_each_other_are_refused():
    """A peak below the continuous current or above the servo's own, and a start below the stop, are refused by name."""
    for peak in (0.3, 5.0):
        with pytest.raises(
            ValueError,
            match=r"peak current of head_pan must be at least continuous_current \(0.46 A\) and at most 3.21 A",
        ):
            Limits(peak_current=peak).currents(OP3)
    with pytest.raises(ValueError, match="start_voltage"):
        Limits(start_voltage=9.5)


@pytest.mark.parametrize(("counts", "jump"), [(4096, "+6.283 rad (+4096 counts)"), (-150, "-0.2")])
def test_a_position_that_jumps_ends_the_run_within_a_tick(tmp_path, counts, jump):
    """A counter that loses a turn, or is reset: torque off before the next tick, and servo and jump are named."""
    rig = faulty(tmp_path)
    rig.robot.at(START, lambda: rig.robot.servos["l_knee"].put("homing_offset", counts))
    outcome = go(rig, folder=tmp_path / "logs")
    assert outcome.code == ExitCode.POSITION_JUMP
    assert "position of l_knee jumped by " + jump[:5] in outcome.reason
    assert_released(rig, outcome)
    assert torque_off(rig) < START + 0.02
    assert np.abs(goals(rig, start=START)[1]).max(initial=0) < 200  # nothing was driven by the wrong angle
    assert "l_knee" in str(Rollout.load(tmp_path / "logs" / "run").metadata.extra)


def test_a_turn_that_is_lost_before_the_first_reading_drives_nothing(tmp_path):
    """After the start checks have seen the joint inside its limits."""
    rig = faulty(tmp_path)
    rig.robot.at(0.9, lambda: rig.robot.servos["l_knee"].put("homing_offset", 4096))
    outcome = go(rig)
    assert outcome.code == ExitCode.POSITION_JUMP
    assert "position of l_knee jumped by +5." in outcome.reason
    assert np.abs(goals(rig)[1]).max(initial=0) == 0


def test_a_servo_whose_torque_another_program_switches_off_ends_the_run(tmp_path):
    """It answers as before, and no current follows its goal: the register is read back within some ticks."""
    rig = make_rig(tmp_path)
    rig.robot.at(START, lambda: rig.robot.servos["l_knee"].write(64, bytes([0])))
    outcome = go(rig)
    assert outcome.code == ExitCode.TORQUE_LOST
    assert outcome.reason.startswith("torque of l_knee was switched off by another program")
    assert_released(rig, outcome)
    assert START < torque_off(rig) < START + 0.3
