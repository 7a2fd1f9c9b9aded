"""Several robots in one scene: the measured run, and models' simulations of it."""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from op3.replay import Prediction
from op3.report.video import states_of_log
from op3.rollout import Rollout, read_log, stand_tilt
from op3.scenes import Scene, build_bench, build_scene

SHOWN = "shown"
"""Subfolder of a diagnosis with the displayed run: measured, before and after."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """One run of one robot, measured and simulated.

    Attributes:
        logs: logs by label; the first is drawn solid, the others as overlays.
        scene: scene in which all logs are drawn.
        known: states ``[frame, nq]`` of the first log at `known_rate` [Hz], if they are known more precisely than from
            a log.
        known_rate: rate of the known states [Hz].
    """

    logs: Mapping[str, Rollout]
    scene: Scene
    known: NDArray[np.float64] | None = None
    known_rate: float = 0.0

    @property
    def duration(self) -> float:
        """Duration of the first log [s]."""
        return next(iter(self.logs.values())).duration

    def states(self, rate: float) -> NDArray[np.float64]:
        """States ``[robot, frame, nq]`` at this frame rate [Hz]; a shorter run stays in its last state."""
        frames = int(self.duration * rate) + 1
        found = [states_of_log(log, self.scene, rate) for log in self.logs.values()]
        if self.known is not None:
            rows = np.arange(frames) * self.known_rate / rate
            found[0] = self.known[np.minimum(rows.astype(int), len(self.known) - 1)]
        return np.stack([one[np.minimum(np.arange(frames), len(one) - 1)] for one in found])

    def joint(self) -> str:
        """The joint in which the first overlay differs most; without overlays, the joint that moves most."""
        first, *overlays = (log.array("joint/position") for log in self.logs.values())
        rows = min(len(first), *(len(overlay) for overlay in overlays)) if overlays else len(first)
        apart = first[:rows] - (overlays[0][:rows] if overlays else first.mean(0))
        return next(iter(self.logs.values())).joints[int(np.nanargmax(np.square(apart).mean(0)))]


def scene_of(log: Rollout) -> Scene:
    """The scene in which a log was recorded, with the log's robot or the part of it that the log contains."""
    known = log.metadata
    if known.mount == "pendulum":
        return build_bench(known.mass, known.length)
    if known.mount != "stand":
        return build_scene(known.mount, robot=log.robot)
    roll, pitch = stand_tilt(log) or (0.0, 0.0)
    return build_scene("stand", tilt_roll=roll, tilt_pitch=pitch, joints=log.joints, robot=log.robot)


def predicted(prediction: Prediction) -> Rollout:
    """A prediction with one parameter set as a separate log."""
    log = prediction.log
    channels: dict[Any, np.ndarray] = {key: values[0].numpy() for key, values in prediction.channels.items()}
    rows = min(len(values) for values in channels.values())
    channels |= {key: log.array(key) for key in log.channels if key == "time" or key[0] == "command"}
    arrays = {key: values[:rows] for key, values in channels.items()}
    return Rollout.from_arrays(arrays, log.metadata.replace(robot="simulated"))


def of_diagnosis(folder: Path) -> Tracks:
    """The run that a diagnosis has stored for viewing."""
    logs = {name: read_log(folder / SHOWN / name) for name in ("measured", "before", "after")}
    return Tracks(logs, scene_of(logs["measured"]))
