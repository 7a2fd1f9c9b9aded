"""Sources of the velocity command of a walking policy: a file, a function, the keyboard, a gamepad."""

from __future__ import annotations

import importlib
import os
import select
import struct
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from op3.common.settings import read_yaml

Array = NDArray[np.float64]

STANDING = np.zeros(3)
"""The command to stop and stand."""

RANGES = {"forward": (-0.1, 0.3), "sideways": (-0.1, 0.1), "turning": (-0.5, 0.5)}
"""Range of velocity commands [m/s, m/s, rad/s], as in the task walk_command."""

LOW, HIGH = (np.array([bounds[side] for bounds in RANGES.values()]) for side in (0, 1))


class CommandSource:
    """A source of velocity commands."""

    def at(self, time: float) -> Array | None:
        """Forwards and to the left [m/s], and rate of turning [rad/s], ``[3]``; None once the source is lost.

        Args:
            time: time since the policy began [s].
        """
        raise NotImplementedError

    def close(self) -> None:
        """Release the opened device, if any."""


def command_source(name: str) -> CommandSource:
    """A source by its name: ``keyboard``, ``gamepad`` or a device such as ``/dev/input/js1``, a YAML file, or
    ``python:<package.module.function>``.

    Raises:
        ValueError: if there is no such source; the message states the remedy.
    """
    if name == "keyboard":
        return Keyboard()
    if name == "gamepad" or name.startswith("/dev/input/"):
        return Gamepad("/dev/input/js0" if name == "gamepad" else name)
    if name.startswith("python:"):
        return Function(name.removeprefix("python:"))
    if Path(name).suffix in (".yaml", ".yml"):
        return Schedule(name)
    raise ValueError(
        f"commands={name}: give keyboard, gamepad, a file such as walk.yaml, or python:<package.module.function>"
    )


class Schedule(CommandSource):
    """Commands from a YAML file.

        commands:  # each holds until the next; the last one ends standing
          - {time: 0.0, forward: 0.2}
          - {time: 4.0, turning: 0.4}
          - {time: 8.0}

    Raises:
        ValueError: if an entry is invalid or times do not increase; the message names file and field.
    """

    def __init__(self, path: str | Path):
        entries = read_yaml(path).get("commands")
        if not isinstance(entries, list) or not entries:
            raise ValueError(f"{path}, field commands: must be a list of {{time: <s>, forward: <m/s>}}")
        times, values = [], []
        for number, entry in enumerate(entries):
            where = f"{path}, field commands.{number}"
            unknown = set(entry) - {"time", *RANGES} if isinstance(entry, dict) else {"it"}
            numbers = isinstance(entry, dict) and all(type(value) in (int, float) for value in entry.values())
            if unknown or not numbers or "time" not in entry:
                raise ValueError(f"{where}: must contain time and any of {', '.join(RANGES)}, each a number")
            times.append(float(entry["time"]))
            values.append([float(entry.get(axis, 0.0)) for axis in RANGES])
        if times != sorted(set(times)):
            raise ValueError(f"{path}, field commands: times must increase, got {times}")
        self._times, self._values = np.array(times), limited(np.array(values))

    def at(self, time: float) -> Array | None:
        """The current entry; before the first entry the command is to stand."""
        number = int(np.searchsorted(self._times, time + 1e-9, side="right")) - 1
        return STANDING.copy() if number < 0 else self._values[number].copy()


class Function(CommandSource):
    """Commands from a Python function of time, which raises an exception or returns None at its end.

    Args:
        path: ``package.module.function``.
    """

    def __init__(self, path: str):
        module, _, name = path.rpartition(".")
        try:
            self._function: Callable[[float], Sequence[float] | None] = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise ValueError(f"commands=python:{path} cannot be imported ({error}); correct the path") from None

    def at(self, time: float) -> Array | None:
        """The function's command; an exception in it counts as a lost source."""
        try:
            value = self._function(time)
            asked = None if value is None else np.asarray(value, dtype=float)
        except Exception as error:  # whatever fails in a user's function, the robot stops and stands
            print(f"the command function failed ({error}); the robot stops", file=sys.stderr)
            return None
        return None if asked is None or asked.shape != (3,) or not np.isfinite(asked).all() else limited(asked)


class Keyboard(CommandSource):
    """Keys in a terminal: w and s for speed, a and d to turn, q and e sideways, space to stop; x ends commanding.

    Args:
        stream: stream whose file descriptor is read; by default the terminal.
    """

    STEPS = {
        "w": (0.05, 0.0, 0.0),
        "s": (-0.05, 0.0, 0.0),
        "a": (0.0, 0.0, 0.1),
        "d": (0.0, 0.0, -0.1),
        "q": (0.0, 0.05, 0.0),
        "e": (0.0, -0.05, 0.0),
    }
    """Increment of each key [m/s, m/s, rad/s]."""

    def __init__(self, stream: int | None = None):
        self._stream = sys.stdin.fileno() if stream is None else stream
        self._asked, self._lost, self._before = STANDING.copy(), False, None
        if os.isatty(self._stream):
            import termios
            import tty

            self._before = termios.tcgetattr(self._stream)
            tty.setcbreak(self._stream)
        elif stream is None:
            raise ValueError("commands=keyboard: there is no terminal; give a file or a gamepad")

    def at(self, time: float) -> Array | None:
        """The sum of the keys so far."""
        del time
        while not self._lost and select.select([self._stream], [], [], 0.0)[0]:
            keys = os.read(self._stream, 64).decode(errors="ignore")
            self._lost = not keys or "x" in keys
            for key in keys:
                if key == " ":
                    self._asked = STANDING.copy()
                elif key in self.STEPS:
                    self._asked = limited(np.round(self._asked + self.STEPS[key], 6))
        return None if self._lost else self._asked.copy()

    def close(self) -> None:
        """Release the terminal."""
        if self._before is not None:
            import termios

            termios.tcsetattr(self._stream, termios.TCSADRAIN, self._before)


class Gamepad(CommandSource):
    """A Linux gamepad: the left stick commands motion, the right stick turning; unplugging it ends the source.

    Events of the joystick interface are 8 bytes: time [ms], value, kind, number (kernel, Documentation/input/joydev).

    Args:
        path: path of the device.
    """

    AXES = {1: (0, -1), 0: (1, -1), 3: (2, -1)}
    """Command and sign of each stick axis, by axis number."""

    DEAD = 0.1
    """Dead zone around the centre of a stick, as a share of its travel, because sticks do not return exactly."""

    def __init__(self, path: str | Path):
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise ValueError(f"commands={path}: no gamepad there ({error.strerror}); plug it in") from None
        self._sticks, self._lost = np.zeros(3), False

    def at(self, time: float) -> Array | None:
        """The command of the sticks."""
        del time
        while not self._lost:
            try:
                event = os.read(self._file, 8)
            except BlockingIOError:
                break
            except OSError:
                event = b""
            self._lost = len(event) < 8
            if not self._lost:
                _, value, kind, number = struct.unpack("<IhBB", event)
                if kind & 2 and number in self.AXES:
                    axis, sign = self.AXES[number]
                    share = sign * value / 32767
                    self._sticks[axis] = 0.0 if abs(share) < self.DEAD else share
        return None if self._lost else np.where(self._sticks > 0, self._sticks * HIGH, -self._sticks * LOW)

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)


def limited(command: Array) -> Array:
    """A command ``[..., 3]`` within `RANGES`."""
    return np.clip(command, LOW, HIGH)
