"""Reads a log in parts while it is recorded, with a model's simulation of the same commands as an overlay."""

import time
from collections.abc import Iterator
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from op3.common.plain_names import words
from op3.replay import Replay
from op3.report.tracks import Tracks, predicted, scene_of
from op3.rollout import LogError, Metadata, Rollout
from op3.rollout.files import GrowingRows
from op3.rollout.rollout import DATA_FOLDER, METADATA_FILE, ROWS_FILE
from op3.servo import RobotModel
from op3.sim import model_for

STRETCH, REACH = 1.0, 10.0
"""Duration of a displayed part, and time before its end at which the overlay starts at rest in the robot's pose [s].

For a standing robot the overlay starts with the displayed part, because it soon falls with open-loop commands.
"""

PATIENCE = (120.0, 6.0)
"""Waiting time for the first row and for further rows, after which following ends [s]."""


class Growing:
    """A log that may still grow. It keeps rows from `REACH` before the displayed part and reads no row twice.

    Args:
        folder: folder of the log, with its metadata.

    Attributes:
        shown: end of the displayed part [s]; minus infinity before the first.
    """

    def __init__(self, folder: Path):
        self.folder, self.shown = folder, -np.inf
        self._rows = GrowingRows(folder / ROWS_FILE)
        self._arrays: dict[Any, np.ndarray] = {}
        self._whole: Rollout | None = None

    def now(self) -> Rollout | None:
        """The rows so far; None before the first row."""
        if self._whole is None and (self.folder / DATA_FOLDER).is_dir():
            log = Rollout.load(self.folder)
            self._whole = log if log.metadata.complete else None
            return log
        if self._whole is None and (new := self._rows.more()):
            late = self._arrays["time"][:, 0] >= self.shown - REACH if self._arrays else slice(0)
            self._arrays = {k: np.concatenate([self._arrays.get(k, v)[late], v]) for k, v in new.items()}
        if self._whole is None and self._arrays:
            return Rollout.from_arrays(self._arrays, Metadata.read(self.folder / METADATA_FILE))
        return self._whole


def stretches(folder: Path, model: RobotModel | str | None) -> Iterator[Tracks | None]:
    """Parts of the growing logs in a folder, one log after the other; None while there is nothing new.

    Args:
        folder: a log, or the folder of a run with several logs on one clock; it need not exist yet.
        model: model of the overlay; None: the robot's model.
    """
    known: dict[Path, Growing] = {}
    seen, last = False, time.monotonic()
    while time.monotonic() - last < PATIENCE[seen]:
        found = _unseen(folder, known)
        if found is None:
            yield None
            time.sleep(0.2)
            continue
        yield _tracks(*found, model)
        seen, last = True, time.monotonic()


def _unseen(folder: Path, known: dict[Path, Growing]) -> tuple[Rollout, float, float] | None:
    """A log with begin and end [s] of its next displayed part, marked as displayed; None if it must grow first."""
    logs = []
    for place in folder.rglob(METADATA_FILE):
        one = known.setdefault(place.parent, Growing(place.parent))
        with suppress(LogError, OSError):  # the log is being closed
            if (log := one.now()) is not None:
                logs.append((log.array("time")[0, 0], one, log))
    ordered = sorted(logs, key=itemgetter(0))
    for number, (first, one, log) in enumerate(ordered, start=1):
        begin, end = max(one.shown, float(first)), float(log.array("time")[-1, 0])
        over = log.metadata.complete or number < len(ordered)
        if end > begin and (over or end - begin >= STRETCH):
            one.shown = end = min(end, begin + STRETCH)
            return log, begin, end
        if not over:
            return None
    return None


def _tracks(log: Rollout, begin: float, end: float, model: RobotModel | str | None) -> Tracks:
    after, scene = float(np.nextafter(end, np.inf)), scene_of(log)
    recent = log.between(begin if scene.floating else max(float(log.array("time")[0, 0]), end - REACH), after)
    logs = {"measured": recent.between(begin, after)}
    try:
        known = model if isinstance(model, RobotModel) else model_for(log.robot, model)
        logs["simulated"] = predicted(Replay([recent], num_threads=1).run(known)[0]).between(begin, after)
    except ValueError:  # such commands do not determine the run
        pass
    return Tracks(logs, scene)


def summary_line(tracks: Tracks) -> str:
    """A part as one line: time, the joint with the largest difference, and the mean difference of all joints."""
    measured, *overlays = tracks.logs.values()
    joint, seconds = tracks.joint(), float(measured.array("time")[-1, 0])
    column = measured.joints.index(joint)
    angles = [np.degrees(log.array("joint/position")[-1, column]) for log in (measured, *overlays)]
    line = f"{seconds:7.1f} s  {words(joint)}: measured {angles[0]:.1f} deg"
    if not overlays:
        return line
    rows = min(measured.rows, overlays[0].rows)
    apart = np.abs(np.subtract(*(log.array("joint/position")[:rows] for log in (measured, overlays[0])))).mean()
    return f"{line}, simulated {angles[1]:.1f} deg; mean difference of all joints {1e3 * apart:.1f} mrad"
