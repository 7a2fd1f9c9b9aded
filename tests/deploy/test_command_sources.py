"""Where a walking policy's commands come from, over real files, a real terminal and a real pipe."""

import os
import pty
import struct
import time

import numpy as np
import pytest

from op3.deploy.command_sources import Gamepad, Keyboard, Schedule, command_source
from op3.deploy.policy_runner import STOPPING, FollowPolicy
from op3.tasks.task import POLICY_PERIOD


def test_a_schedule_holds_each_command(tmp_path):
    """Entries hold until the next; what is beyond the ranges is cut; before the first the robot stands."""
    path = tmp_path / "walk.yaml"
    path.write_text("commands:\n  - {time: 1.0, forward: 0.9}\n  - {time: 2.0, turning: -0.4}\n  - {time: 3}\n")
    source = command_source(str(path))
    asked = [source.at(t).tolist() for t in (0.5, 1.0, 1.9, 2.0, 9.0)]
    assert asked == [[0, 0, 0], [0.3, 0, 0], [0.3, 0, 0], [0, 0, -0.4], [0, 0, 0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("commands: 3", "field commands: must be a list"),
        ("commands: [{time: 0.0, foward: 0.2}]", r"field commands\.0: must contain time and any of forward"),
        ("commands: [{forward: 0.2}]", r"field commands\.0: must contain time"),
        ("commands: [{time: 0.0, forward: fast}]", r"field commands\.0: must contain time"),
        ("commands: [{time: 2.0}, {time: 1.0}]", "times must increase"),
    ],
)
def test_a_wrong_schedule_is_named(tmp_path, text, message):
    """One sentence names the file and the field."""
    path = tmp_path / "walk.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        Schedule(path)


def test_unknown_sources_are_named():
    """A source that does not exist, a device that is not there, and a function that cannot be imported."""
    with pytest.raises(ValueError, match="commands=mouse: give keyboard, gamepad"):
        command_source("mouse")
    with pytest.raises(ValueError, match="commands=/dev/input/js99: no gamepad there"):
        command_source("/dev/input/js99")
    with pytest.raises(ValueError, match=r"commands=python:math\.walk cannot be imported"):
        command_source("python:math.walk")


def test_a_function_of_ones_own(tmp_path, monkeypatch):
    """It is asked for every time; when it fails the source is lost."""
    (tmp_path / "my_commands.py").write_text("def walk(time):\n    return [0.1, 0.0, 0.2] if time < 1 else 1 / 0\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    source = command_source("python:my_commands.walk")
    assert source.at(0.0).tolist() == [0.1, 0.0, 0.2]
    assert source.at(1.0) is None


def test_keys_of_a_terminal():
    """Two steps forwards and one to the left add up; space stops; x loses the source; the terminal is given back."""
    outside, inside = pty.openpty()
    source = Keyboard(inside)
    os.write(outside, b"wwa")
    time.sleep(0.05)
    np.testing.assert_allclose(source.at(0.0), [0.1, 0.0, 0.1])
    os.write(outside, b"w ")
    time.sleep(0.05)
    assert source.at(0.0).tolist() == [0, 0, 0]
    os.write(outside, b"x")
    time.sleep(0.05)
    assert source.at(0.0) is None
    source.close()
    os.close(outside)
    os.close(inside)


def test_sticks_of_a_gamepad(tmp_path):
    """Events of the joystick interface move the command; a closed device loses the source."""
    path = tmp_path / "js0"
    os.mkfifo(path)
    reader = Gamepad(path)
    writer = os.open(path, os.O_WRONLY)
    os.write(writer, struct.pack("<IhBB", 0, -32767, 2, 1) + struct.pack("<IhBB", 1, 16384, 2, 3))
    np.testing.assert_allclose(reader.at(0.0), [0.3, 0.0, -0.25], atol=1e-4)
    os.write(writer, struct.pack("<IhBB", 2, 1000, 2, 1))
    assert reader.at(0.0)[0] == 0.0
    os.close(writer)
    assert reader.at(0.0) is None
    reader.close()


class _Runner:
    """As much of a policy as the phase needs to ask for commands."""

    def reset(self):
        self.velocity = np.zeros(3)


class _Source:
    """Walks, and is lost after a second."""

    def at(self, time):
        return np.array([0.2, 0.0, 0.0]) if time < 1.0 or time > 2.0 else None

    def close(self):
        """Nothing is open."""


def test_a_lost_source_stops_for_good_and_so_does_the_end():
    """Once lost, a source that comes back does not start the robot again; the last seconds are for standing."""
    lost = FollowPolicy(_Runner(), 10.0, _Source())
    steps = np.arange(round(10.0 / POLICY_PERIOD))
    asked = np.array([lost._asked(step)[0] for step in steps])
    assert set(asked[steps * POLICY_PERIOD < 1.0]) == {0.2}
    assert not asked[steps * POLICY_PERIOD >= 1.0].any()
    walks = FollowPolicy(_Runner(), 10.0, command_source("python:tests.deploy.test_command_sources.walking"))
    asked = np.array([walks._asked(step)[0] for step in steps])
    ends = steps * POLICY_PERIOD > 10.0 - STOPPING + POLICY_PERIOD
    assert set(asked[~ends][:-2]) == {0.2}
    assert not asked[ends].any()


def walking(time):
    """Forwards all the time."""
    del time
    return [0.2, 0.0, 0.0]
