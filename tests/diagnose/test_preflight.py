"""Logs that cannot carry a verdict."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from op3.diagnose import Diagnosis, split_logs
from op3.diagnose.labels import mislabelled
from op3.diagnose.preflight import Caution, _lines, preflight
from op3.diagnose.split import LogSplit
from op3.robot import leg_suite
from op3.rollout import Metadata, Rollout, stand_tilt
from op3.sim import load_model
from op3.stand_in import draw_case, record_case


def log(duration: float, reach: float, speed: float = 3.0, multiples=(1.0,)) -> Rollout:
    """Two joints, of which the second moves by `reach` [rad]; they turn `speed` times a second, over 2 pi.

    Args:
        multiples: of `speed` that are added up, each with the same amplitude of the velocity.
    """
    time = np.arange(round(duration * 125)) / 125
    wave = sum(np.sin(multiple * speed * time) / multiple for multiple in multiples)
    position = np.stack([wave, reach * wave], 1)
    metadata = Metadata(joints=("r_knee", "r_hip_pitch"), robot="simulated", mount="stand", rate=125.0)
    return Rollout.from_arrays({"time": time, "joint/position": position, "command/position": position}, metadata)


def said(*logs: Rollout) -> tuple[Caution, ...]:
    """What preflight has to say against logs that are fitted."""
    return tuple(one for one in preflight(LogSplit(logs, (), ()), load_model("paper")) if not one.assumed)


def changed(logs, change) -> list[Rollout]:
    """Logs after `change(arrays)`."""
    result = []
    for one in logs:
        arrays = {key: one.array(key).copy() for key in one.channels}
        change(arrays)
        result.append(Rollout.from_arrays(arrays, one.metadata))
    return result


@pytest.fixture(scope="module")
def leg() -> list[Rollout]:
    """Logs of a leg with nothing hidden in it."""
    return list(record_case(draw_case(9001, "null", robot="leg"), leg_suite(9001)[::2]))


def test_short_logs_and_still_joints_are_told():
    """Five seconds in which one joint hardly moves: both are said, with the joint's name."""
    short, still, *_ = said(log(5.0, 0.005))
    assert "5 s" in short.text
    assert short.joints == ()
    assert still.joints == ("r_hip_pitch",)
    assert "r_knee" not in still.text


def test_what_is_taken_for_granted_is_told_and_weakens_nothing():
    """Joints of a limb that are not in the logs, and a stand whose tilt nobody told; with both told nothing is said."""
    bare = log(20.0, 0.5, multiples=(1.0, 2.7))
    limb, tilt = (one for one in preflight(LogSplit((bare,), (), ()), load_model("paper")) if one.assumed)
    assert "r_ank_roll" in limb.text
    assert "tilt" in tilt.text
    assert not limb.weakens(())
    assert not tilt.weakens(("r_knee",))
    told = Rollout(bare.data, bare.metadata.replace(extra={"tilt": [0.0, 0.3]}))
    assert stand_tilt(told) == (0.0, 0.3)
    (left,) = (one for one in preflight(LogSplit((told,), (), ()), load_model("paper")) if one.assumed)
    assert left.text == limb.text


def test_rich_logs_pass():
    """Twenty seconds with all joints in motion, slow at their turns and fast between, say nothing."""
    assert said(log(20.0, 0.5, multiples=(1.0, 2.7))) == ()


def test_one_sine_is_told():
    """Runs of one sine each at much the same rate lock speed to position, however many there are."""
    walks = [log(10.0, 0.5, speed) for speed in (2.0, 3.0, 4.0)]
    (caution,) = said(*walks)
    assert "one sine" in caution.text
    assert caution.weakens((), "stribeck")
    assert said(*walks, log(30.0, 0.5, multiples=(1.0, 2.7, 5.3, 7.9))) == ()


@given(st.floats(4.0, 30.0), st.integers(1, 4), st.floats(0.1, 10.0))
def test_lines_are_counted(slowest, number, scale):
    """So many sines of equal speed are so many lines, whatever their size."""
    one = log(20.0, scale, slowest, multiples=1.0 + np.arange(number))
    assert _lines([one], 1) == pytest.approx(number, rel=0.15)


@pytest.mark.parametrize("rich", [0, 1, 2])
def test_what_most_moving_joints_lack_is_said_of_what_all_share(rich):
    """Of three joints that move two with one sine each speak against a shared effect, and one does not."""
    time = np.arange(2500) / 125
    sine, wave = np.sin(3.0 * time), np.sin(3.0 * time) + np.sin(8.1 * time) / 2.7
    position = np.stack([*[wave] * rich, *[sine] * (3 - rich), 0 * time], 1)
    metadata = Metadata(
        joints=("r_knee", "r_hip_pitch", "r_ank_pitch", "r_hip_yaw"), robot="simulated", mount="stand", rate=125.0
    )
    _, caution = said(
        Rollout.from_arrays({"time": time, "joint/position": position, "command/position": position}, metadata)
    )
    assert caution.weakens((), "stribeck") is (rich < 2)
    assert caution.weakens(("r_ank_pitch",), "stribeck")
    assert caution.weakens(("r_knee",), "stribeck") is (rich == 0)


def test_what_moves_without_a_command_is_not_judged_by_it():
    """A swing with the torque off, or a joint that is pushed: the target stays, and says nothing of the motion."""
    free = log(20.0, 0.5)
    held = changed([free], lambda arrays: arrays["command", "position"].fill(0.3))
    assert _lines(held, 1) == np.inf
    assert said(*held) == ()


@pytest.mark.parametrize("walked", [4.0, 8.0, 12.0])
def test_standing_still_is_no_further_line(walked):
    """A walk of some seconds that then stands for as long is one sine still, and so is one with a hole in its clock."""
    one = log(2 * walked, 1.0, 8.0)

    def stop(arrays):
        late = arrays["time"][:, 0] > walked
        for channel in (("joint", "position"), ("command", "position")):
            arrays[channel][late] = arrays[channel][~late][-1]

    assert _lines(changed([one], stop), 0) < 2.0
    gap = one.array("time")[:, 0] < 0.4 * walked
    late = one.array("time")[:, 0] > 0.4 * walked + 0.2
    arrays = {key: one.array(key)[gap | late] for key in one.channels}
    assert _lines([Rollout.from_arrays(arrays, one.metadata)], 0) < 2.0


def test_slow_motion_alone_is_told():
    """Joints that never move fast tell nothing of viscous friction or delay."""
    caution, _ = said(log(40.0, 0.8, speed=0.5))
    assert "faster than" in caution.text
    assert caution.joints == ()


def test_a_caution_weakens_names_in_its_joints_only():
    """A still joint speaks against a fault of its own, and not against what all joints share."""
    caution = Caution("still", joints=("r_knee", "r_hip_pitch"))
    assert caution.weakens(("r_knee",))
    assert not caution.weakens(("r_knee", "r_ank_pitch"))
    assert not caution.weakens(())
    assert Caution("short").weakens(())


def test_a_leg_with_right_labels_passes(leg):
    """Its deliberate exhaustion of the voltage is no saturation, and its names are its own."""
    assert preflight(split_logs(leg), load_model("paper")) == ()


def test_servos_at_their_limit_are_told(leg):
    """A knee that draws a tenth of what its gains ask for is told, with what to record."""

    def starve(arrays):
        arrays["command", "p_gain"][:, 3] *= 10
        arrays["command", "d_gain"][:, 3] *= 10

    cautions = preflight(split_logs(changed(leg, starve)), load_model("paper"))
    (caution,) = (caution for caution in cautions if caution.joints == ("r_knee",) and "lower gains" in caution.text)
    assert caution.weakens(("r_knee",), "viscous")
    assert not caution.weakens(("r_knee",), "latency")  # it makes loops swing as far as the servos go


@pytest.mark.parametrize(
    ("channel", "factor", "unit"),
    [
        (("joint", "velocity"), 57.296, "degrees per second"),
        (("joint", "velocity"), 9.549, "rpm"),
        (("joint", "current"), 1000.0, "milliamperes"),
        (("joint", "velocity"), -1.0, "sign is turned"),
        (("joint", "current"), -1.0, "sign is turned"),
    ],
)
def test_units_and_signs_are_told(leg, channel, factor, unit):
    """One joint's channel in another unit, or turned, is told with its name."""

    def scale(arrays):
        arrays[channel][:, 2] *= factor

    (text,) = mislabelled(changed(leg, scale), load_model("paper"))
    assert "r_hip_pitch" in text
    assert unit in text


def test_a_slow_filter_is_no_other_unit(leg):
    """Velocities through a filter of 16 ms are halved in quick motions, and keep their unit."""

    def slow(arrays):
        velocity, share = arrays["joint", "velocity"], 1.0 - np.exp(-0.008 / 0.016)
        for row in range(1, len(velocity)):
            velocity[row] = velocity[row - 1] + share * (velocity[row] - velocity[row - 1])

    assert mislabelled(changed(leg, slow), load_model("paper")) == ()


@pytest.mark.parametrize("channel", [("joint", "position"), ("joint", "current")])
def test_exchanged_columns_of_one_channel_are_told(leg, channel):
    """Knee and hip exchanged in one channel contradict the others."""

    def exchange(arrays):
        arrays[channel][:, [2, 3]] = arrays[channel][:, [3, 2]]

    found = mislabelled(changed(leg, exchange), load_model("paper"))
    assert found
    assert "r_knee" in " ".join(found)


def test_names_exchanged_in_all_channels_are_told(leg):
    """Channels that agree with each other, but not with the body that they are said to move."""

    def exchange(arrays):
        for key in arrays:
            if key[0] in ("joint", "command"):
                arrays[key][:, [2, 3]] = arrays[key][:, [3, 2]]

    (text,) = mislabelled(changed(leg, exchange), load_model("paper"))
    assert "r_hip_pitch and r_knee were exchanged" in text


def test_a_joint_whose_axis_is_turned_in_all_channels_is_told(leg):
    """A knee that bends the other way in every channel does not carry the leg."""

    def turn(arrays):
        for key in (("joint", "position"), ("joint", "velocity"), ("joint", "current"), ("command", "position")):
            arrays[key][:, 3] *= -1

    (text,) = mislabelled(changed(leg, turn), load_model("paper"))
    assert "sign of r_knee" in text


@pytest.mark.slow
def test_mislabelled_logs_are_not_diagnosed(leg):
    """No name, no fit, and what to mend in the sentence."""

    def turn(arrays):
        arrays["joint", "current"][:, 2] *= -1

    verdict = Diagnosis(load_model("paper"), split_logs(changed(leg, turn))).run()
    assert (verdict.verdict, verdict.effects) == ("unknown", ())
    assert "cannot tell" in verdict.sentence
    assert "r_hip_pitch" in verdict.sentence


@pytest.mark.slow
def test_short_logs_give_no_confident_name():
    """Ten seconds of a leg with much more friction in one joint: a candidate at most, and what to record next."""
    case = draw_case(9003, "single", "strong", "coulomb", robot="leg")
    logs = list(record_case(case, leg_suite(9003)))
    verdict = Diagnosis(load_model(case.base), split_logs(logs[:4])).run()
    assert verdict.verdict != "named"
    assert all(effect.confidence <= 0.5 for effect in verdict.effects)
    assert any("record at least" in text for text in verdict.cannot_tell)


def test_logs_in_which_nothing_moved_are_not_sound(leg):
    """No name, and a verdict that no script takes for a sound robot."""

    def hold(arrays):
        for key in (("joint", "position"), ("joint", "velocity"), ("joint", "current"), ("command", "position")):
            arrays[key][:] = arrays[key][:1]

    verdict = Diagnosis(load_model("paper"), split_logs(changed(leg, hold))).run()
    assert (verdict.verdict, verdict.effects) == ("unknown", ())
    assert verdict.sentence.startswith("These logs cannot tell whether anything is missing: ")
