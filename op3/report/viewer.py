"""Viewer of runs: a window, an mp4, or a recording for rerun, with plots beside the robots."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from op3.common.plain_names import words
from op3.report.frames import add_overlay, camera_of, draw_frames
from op3.report.style import COMMAND, GRID, GROUND, INK, MUTED, PALETTE
from op3.report.tracks import Tracks
from op3.rollout import Rollout

RATE = 30.0
"""Frames per second [Hz]."""

PICTURE, PLOTS = (720, 720), (720, 560)
"""Height and width of the robots and of the plots beside them [pixel]."""

QUANTITIES: Mapping[str, tuple[tuple[str, str], float]] = {
    "angle [deg]": (("joint", "position"), 180 / np.pi),
    "current [A]": (("joint", "current"), 1.0),
    "P gain [A/rad]": (("command", "p_gain"), 1.0),
    "gain [firmware]": (("command", "firmware_gain"), 1.0),
}
"""Plotted channels, if a log has them, and their factors from SI units."""

Plot = list[tuple[str, NDArray[np.float64], NDArray[np.float64]]]
"""Label, time [s] and values of every line."""


def rgb(colour: str) -> tuple[float, float, float]:
    """A colour ``#rrggbb`` as red, green and blue, 0 to 1."""
    return tuple(int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))  # type: ignore[return-value]


def lines_of(tracks: Tracks, joint: str) -> dict[str, Plot]:
    """Plotted lines of a joint, by axis."""
    plots: dict[str, Plot] = {}
    first = next(iter(tracks.logs.values()))
    for axis, (key, factor) in QUANTITIES.items():
        lines = [_line(label, log, key, joint, factor) for label, log in tracks.logs.items() if key in log]
        if key == ("joint", "position") and ("command", "position") in first:
            lines.insert(0, _line(COMMAND, first, ("command", "position"), joint, factor))
        if lines:
            plots[axis] = lines
    return plots


def _line(label: str, log: Rollout, key: tuple[str, str], joint: str, factor: float) -> tuple[str, Any, Any]:
    seconds = log.array("time")[:, 0] - log.array("time")[0, 0]
    return label, seconds, factor * log.array(key)[:, log.joints.index(joint)]


class Strip:
    """Plots of one joint over time, drawn once; `at` moves the time cursor.

    Args:
        joint: plotted joint; None: `Tracks.joint`.
        size: height and width [pixel].
    """

    def __init__(self, tracks: Tracks, joint: str | None = None, size: tuple[int, int] = PLOTS):
        self.joint = joint or tracks.joint()
        self._duration = max(tracks.duration, 1e-6)
        self._fine = 2  # lines are drawn at twice the size to smooth them
        height, width = (self._fine * side for side in size)
        self._left, self._right, self._top, self._bottom = 110, width - 40, 130, height - 80
        self._image = Image.new("RGB", (width, height), GROUND)
        draw = ImageDraw.Draw(self._image)
        colours = dict(zip(tracks.logs, (INK, *PALETTE), strict=False)) | {COMMAND: MUTED}
        plots = lines_of(tracks, self.joint)
        draw.text((self._left, 24), words(self.joint), INK, _font(34))
        x = self._left
        for label in dict.fromkeys(line[0] for plot in plots.values() for line in plot):
            draw.line((x, 96, x + 36, 96), colours[label], 6)
            draw.text((x + 46, 80), label, INK, _font(26))
            x += 76 + round(_font(26).getlength(label))
        room = (self._bottom - self._top) / max(len(plots), 1)
        for number, (axis, lines) in enumerate(plots.items()):
            self._plot(draw, axis, lines, colours, self._top + number * room, room - 64)
        for second in range(0, int(self._duration) + 1, max(1, round(self._duration / 6))):
            draw.text((self._x(second), self._bottom - 14), f"{second} s", MUTED, _font(24), anchor="mt")

    def _x(self, seconds: Any) -> Any:
        return self._left + (self._right - self._left) * seconds / self._duration

    def _plot(
        self, draw: ImageDraw.ImageDraw, axis: str, lines: Plot, colours: Mapping[str, str], top: float, height: float
    ) -> None:
        everything = np.concatenate([values[np.isfinite(values)] for _, _, values in lines])
        low, high = (float(everything.min()), float(everything.max())) if everything.size else (0.0, 1.0)
        low, high = (low, high) if high > low else (low - 0.5, high + 0.5)
        draw.text((self._left, top), axis, MUTED, _font(24))
        top, height = top + 36, height - 36
        for value in (low, high):
            y = top + height * (high - value) / (high - low)
            draw.line((self._left, y, self._right, y), GRID, 2)
            draw.text((self._left - 12, y), f"{value:.3g}", MUTED, _font(22), anchor="rm")
        for label, seconds, values in lines:
            y = top + height * (high - np.nan_to_num(values, nan=low)) / (high - low)
            # the first (measured) line is below the others and therefore wider
            width = 3 if label == COMMAND else 9 if colours[label] == INK else 4
            draw.line(list(np.stack([self._x(seconds), y], 1).ravel()), colours[label], width)

    def at(self, seconds: float) -> NDArray[np.uint8]:
        """The plots at a time [s], ``[height, width, 3]``."""
        image = self._image.copy()
        x = self._x(min(seconds, self._duration))
        ImageDraw.Draw(image).line((x, self._top, x, self._bottom - 20), MUTED, 3)
        return np.asarray(image.reduce(self._fine))


def _font(size: int) -> Any:
    return ImageFont.load_default(size)


def overlay_colours(tracks: Tracks) -> list[tuple[float, float, float]]:
    """Colours of all robots except the first, which match their lines."""
    return [rgb(colour) for _, colour in zip(list(tracks.logs)[1:], PALETTE, strict=False)]


def pictures(tracks: Tracks, joint: str | None = None, speed: float = 1.0) -> Iterator[NDArray[np.uint8]]:
    """Frames of the robots beside the plots, at `RATE` frames per second.

    Raises:
        RenderError: if rendering is not possible on this machine.
    """
    rate, strip = RATE / speed, Strip(tracks, joint)
    frames = draw_frames(tracks.scene.compile(), tracks.states(rate), size=PICTURE, overlays=overlay_colours(tracks))
    for number, frame in enumerate(frames):
        yield np.concatenate([frame, strip.at(number / rate)], axis=1)


@dataclass
class Playback:
    """Playback in a window: position [s], speed relative to real time, and keys."""

    duration: float
    seconds: float = 0.0
    speed: float = 1.0
    playing: bool = True

    KEYS = "space: play or pause; left, right: half a second; comma, point: a frame; up, down: speed; Home: restart"

    def key(self, code: int) -> None:
        """Handle a key of GLFW."""
        jumps = {262: 0.5, 263: -0.5, 46: 1 / RATE, 44: -1 / RATE, 268: -self.duration}
        if code == 32:
            self.playing = not self.playing
        elif code in (265, 264):
            self.speed = min(max(self.speed * (2.0 if code == 265 else 0.5), 1 / 16), 16.0)
        elif code in jumps:
            self.seconds = min(max(self.seconds + jumps[code], 0.0), self.duration)
            self.playing = self.playing and code not in (44, 46)

    def advance(self, elapsed: float) -> bool:
        """Advance by a time [s]; return whether playback restarted at the end."""
        ahead = self.seconds + self.speed * elapsed * self.playing
        self.seconds = ahead % max(self.duration, 1e-9) if self.playing else ahead
        return self.playing and ahead >= self.duration


def window(stretches: Iterable[Tracks | None], joint: str | None = None, speed: float = 1.0) -> None:
    """Play in MuJoCo's viewer until it is closed.

    Args:
        stretches: parts that are played in turn, the last one repeatedly; None while the next part is not available.
        joint: joint of the plots; None: `Tracks.joint`.
        speed: playback speed relative to real time.
    """
    import mujoco.viewer

    coming = iter(stretches)
    tracks = next((one for one in coming if one is not None), None)
    if tracks is None:
        raise ValueError("there is nothing to show: no log was started in this folder")
    model = tracks.scene.compile()
    data, overlay, player = mujoco.MjData(model), mujoco.MjData(model), Playback(tracks.duration, speed=speed)
    states, strip = tracks.states(RATE), Strip(tracks, joint)
    data.qpos[:] = states[0, 0]
    mujoco.mj_forward(model, data)
    options: dict[str, Any] = {"key_callback": player.key, "show_left_ui": False, "show_right_ui": False}
    print(Playback.KEYS, flush=True)
    with mujoco.viewer.launch_passive(model, data, **options) as handle:
        seen = camera_of(model, data)
        handle.cam.lookat[:], handle.cam.distance = seen.lookat, seen.distance
        handle.cam.azimuth, handle.cam.elevation = seen.azimuth, seen.elevation
        last = time.monotonic()
        while handle.is_running():
            now = time.monotonic()
            if player.advance(now - last) and (more := next(coming, None)) is not None:
                states, strip, player.duration, player.seconds = more.states(RATE), Strip(more, joint), more.duration, 0
            last, row = now, min(int(player.seconds * RATE), states.shape[1] - 1)
            with handle.lock():
                assert handle.user_scn is not None
                data.qpos[:] = states[0, row]
                mujoco.mj_forward(model, data)
                handle.user_scn.ngeom = 0
                for colour, robot in zip(overlay_colours(tracks), states[1:], strict=False):
                    overlay.qpos[:] = robot[row]
                    mujoco.mj_kinematics(model, overlay)
                    add_overlay(model, overlay, handle.user_scn, colour)
            image, place = strip.at(player.seconds), handle.viewport
            if place is not None and place.width > PLOTS[1] and place.height > PLOTS[0]:
                right = mujoco.MjrRect(place.width - PLOTS[1], place.height - PLOTS[0], PLOTS[1], PLOTS[0])
                handle.set_images((right, image))
            handle.sync()
            time.sleep(max(0.0, 1 / RATE - (time.monotonic() - now)))
