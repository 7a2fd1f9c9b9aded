"""A log while it is being recorded: stretch by stretch, with what a model makes of the same commands as the ghost."""

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from op3.report.style import words
from op3.report.tracks import Tracks, predicted, scene_of
from op3.rollout import LogError, Rollout, read_log
from op3.rollout.rollout import METADATA_FILE
from op3.servo import RobotModel
from op3.sim import model_for
from op3.tasks import Replay

STRETCH, REACH = 1.0, 10.0
"""How much is shown at once, and how long before its end the ghost has begun, at rest and where the robot was [s].

On its feet it begins with the stretch: commands alone do not keep it there for long.
"""

PATIENCE = (120.0, 6.0)
"""Without a first row, and without another one, for so long [s] nothing more is awaited."""


def stretches(folder: Path, model: RobotModel | str | None) -> Iterator[Tracks | None]:
    """Stretches of the logs in a folder as they grow, one log after the other; None while there is nothing new.

    Args:
        folder: a log, or the folder of a run with some, which share a clock; it may not be there yet.
        model: of the ghost; the robot's own where None.
    """
    shown: dict[Path, float] = {}
    last = time.monotonic()
    while time.monotonic() - last < PATIENCE[bool(shown)]:
        found = _unseen(folder, shown)
        if found is None:
            yield None
            time.sleep(0.2)
            continue
        yield _tracks(*found, model)
        last = time.monotonic()


def _unseen(folder: Path, shown: dict[Path, float]) -> tuple[Rollout, float, float] | None:
    """A log with begin and end [s] of what of it is shown next, and so counts as shown; None: it must grow first."""
    logs: dict[Path, Rollout] = {}
    for place in folder.rglob(METADATA_FILE):
        with suppress(LogError, OSError):  # nothing is on the disk yet, or it is being closed at this moment
            logs[place.parent] = read_log(place.parent)
    ordered = sorted(logs.items(), key=lambda item: item[1].array("time")[0, 0])
    for number, (place, log) in enumerate(ordered, start=1):
        times = log.array("time")[:, 0]
        begin, end = shown.get(place, float(times[0])), float(times[-1])
        over = log.metadata.complete or number < len(ordered)
        if end > begin and (over or end - begin >= STRETCH):
            shown[place] = end = min(end, begin + STRETCH)
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
    except ValueError:  # commands of this kind do not tell the whole run
        pass
    return Tracks(logs, scene)


def told(tracks: Tracks) -> str:
    """A stretch in a line: its time, the joint that differs most, and how far all of them are apart."""
    measured, *ghosts = tracks.logs.values()
    joint, seconds = tracks.joint(), float(measured.array("time")[-1, 0])
    column = measured.joints.index(joint)
    angles = [np.degrees(log.array("joint/position")[-1, column]) for log in (measured, *ghosts)]
    line = f"{seconds:7.1f} s  {words(joint)}: measured {angles[0]:.1f} deg"
    if not ghosts:
        return line
    rows = min(measured.rows, ghosts[0].rows)
    apart = np.abs(np.subtract(*(log.array("joint/position")[:rows] for log in (measured, ghosts[0])))).mean()
    return f"{line}, simulated {angles[1]:.1f} deg; all joints {1e3 * apart:.1f} mrad apart"
