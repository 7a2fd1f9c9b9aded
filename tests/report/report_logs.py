"""Small logs and page readers that the tests of this folder share."""

from html.parser import HTMLParser

import numpy as np

from op3.rollout import Metadata, Rollout

VOID = {"meta", "img", "br", "link", "input", "hr"}


def squat_log(
    rows: int = 60, leave_out: tuple[str, ...] = (), joints: tuple[str, ...] = ("l_knee", "r_knee")
) -> Rollout:
    """A log with joint and body channels, all different; channels in `leave_out` are absent."""
    time = 0.008 * np.arange(rows)
    wave = np.sin(2 * np.pi * time)[:, None] * np.arange(1, len(joints) + 1)
    arrays = {
        "time": time,
        "command/position": 0.5 * wave,
        "joint/position": 0.4 * wave,
        "joint/velocity": 2.0 * wave,
        "joint/current": 0.1 * wave,
        "imu/orientation": 0.01 * wave[:, :1] * np.ones(3),
        "imu/angular_velocity": 0.1 * wave[:, :1] * np.ones(3),
    }
    arrays = {key: value for key, value in arrays.items() if key not in leave_out}
    return Rollout.from_arrays(arrays, Metadata(joints=joints, robot="simulated", mount="stand", rate=125.0))


def bench_log(motion: str, mass: float, gain: float) -> Rollout:
    """A run of the servo bench: no current and no body."""
    time = 0.005 * np.arange(40)
    arrays = {"time": time, "command/position": np.sin(time)[:, None], "joint/position": 0.9 * np.sin(time)[:, None]}
    metadata = Metadata(("servo",), "rig", "pendulum", 200.0, mass=mass, length=0.1, firmware_gain=gain, motion=motion)
    return Rollout.from_arrays(arrays, metadata)


class PageReader(HTMLParser):
    """Reads a page: tags must nest; collects text outside scripts, attributes, and embedded figures."""

    def __init__(self, html: str):
        super().__init__()
        self.open: list[str] = []
        self.texts: list[tuple[str, str]] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.scripts: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            self.scripts.append(data)
        elif self.open and self.open[-1] != "style" and data.strip():
            self.texts.append((self.open[-1], data))

    @property
    def text(self) -> str:
        """All visible text."""
        return " ".join(text for _, text in self.texts)
