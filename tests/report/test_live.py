"""A log that grows is shown while it does, on a terminal as well."""

import os
import pty
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from op3.motions import squat
from op3.replay import simulate_motion
from op3.report import live
from op3.report.tracks import Tracks, scene_of
from op3.rollout import Recorder, Rollout
from op3.sim import load_model

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def log() -> Rollout:
    """Two seconds in the stand."""
    return simulate_motion(load_model("paper"), squat(duration=2.0), mount="stand")


def record(log: Rollout, folder: Path) -> None:
    """Write a log row by row, as a deployment does."""
    with Recorder(folder, log.metadata) as recorder:
        for row in range(log.rows):
            recorder.append({key: log.array(key)[row] for key in log.channels})
            time.sleep(0.004)


def test_stretches_follow_one_another_to_the_end(log, tmp_path, monkeypatch):
    """Two seconds come as stretches that begin where the last one ended, each with its overlay; then it is over."""
    monkeypatch.setattr(live, "PATIENCE", (60.0, 10.0))
    writer = threading.Thread(target=record, args=(log, tmp_path / "run" / "log"))
    writer.start()
    found = [tracks for tracks in live.stretches(tmp_path / "run", None) if tracks is not None]
    writer.join()
    ends = [(one.array("time")[0, 0], one.array("time")[-1, 0]) for one in (each.logs["measured"] for each in found)]
    assert (ends[0][0], ends[-1][1]) == (log.array("time")[0, 0], log.array("time")[-1, 0])
    assert all(before[1] == after[0] for before, after in pairwise(ends))
    assert all(list(one.logs) == ["measured", "simulated"] for one in found)


def test_the_logs_of_a_run_are_shown_in_the_order_of_their_clock(log, tmp_path, monkeypatch):
    """The approach, of 1.2 s, comes whole, in two stretches, before what follows it, whatever they are called."""
    monkeypatch.setattr(live, "PATIENCE", (60.0, 0.1))
    for name, begin, end in (("run", 1.2, 2.0), ("zero", 0.0, 1.2)):
        log.between(begin, end).save(tmp_path / name)
    found = [tracks.logs["measured"].array("time")[0, 0] for tracks in live.stretches(tmp_path, None) if tracks]
    assert found == pytest.approx([0.0, 1.0, 1.2])


def test_of_a_run_of_hours_only_the_last_seconds_are_held_and_none_is_read_twice(log, tmp_path, monkeypatch):
    """Half a second is kept before what was shown; what was read once may be gone from the disk."""
    monkeypatch.setattr(live, "REACH", 0.5)
    rows = [{key: log.array(key)[row] for key in log.channels} for row in range(log.rows)]
    recorder, growing = Recorder(tmp_path / "log", log.metadata), live.Growing(tmp_path / "log")
    for part, rest in ((rows[:150], log.between(0.0, 1.2)), (rows[150:], log.between(0.7, 9.0))):
        for row in part:
            recorder.append(row)
        recorder._flush()
        now = growing.now()
        assert np.array_equal(now.array("joint/position"), rest.array("joint/position"))
        growing.shown = 1.2
        with (tmp_path / "log" / "rows.bin").open("r+b") as file:
            file.write(b"x" * 1000)
    recorder.abandon()
    assert not growing.now().metadata.complete


def test_a_line_tells_the_joint_that_differs_most(log):
    """A overlay whose left knee is 0.2 rad ahead, of twenty joints: 10 mrad in the mean."""
    knee, ahead = log.joints.index("l_knee"), {key: log.array(key).copy() for key in log.channels}
    ahead["joint", "position"][:, knee] += 0.2
    logs = {"measured": log, "simulated": Rollout.from_arrays(ahead, log.metadata)}
    line = live.summary_line(Tracks(logs, scene_of(log)))
    angle = np.degrees(log.array("joint/position")[-1, knee])
    assert f"left knee: measured {angle:.1f} deg, simulated {angle + np.degrees(0.2):.1f} deg" in line
    assert line.endswith("mean difference of all joints 10.0 mrad")


def test_op3_view_follows_a_run_on_a_terminal(log, tmp_path):
    """Over a real terminal without a screen: a line per stretch while rows come in, and a video in the end."""
    ours, theirs = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "op3",
        "view",
        "run",
        "live=true",
        "out=video.mp4",
        "speed=8",
        "hydra.run.dir=view",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        environment.pop(name, None)
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    record(log, tmp_path / "run" / "log")
    said = b""
    while chunk := _read(ours):
        said += chunk
    assert b"deg; mean difference of all joints" in said
    assert process.wait(60) == 0 or b"cannot render" in said, said
    assert (tmp_path / "video.mp4").is_file() or b"cannot render" in said


def _read(terminal: int) -> bytes:
    """What a terminal has to say; nothing once its program has ended."""
    try:
        return os.read(terminal, 4096)
    except OSError:
        return b""
