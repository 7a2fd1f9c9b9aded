"""The recorder: whole logs, refused rows, crashes, speed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from rollout_logs import RATE, arrays, assert_same, metadata, rollout

from op3.rollout import LogError, Metadata, Recorder, Rollout

ROOT = Path(__file__).resolve().parents[2]


def rows_of(values):
    """The rows of a log, one mapping per tick."""
    for i in range(len(values["time"])):
        yield {key: value[i] for key, value in values.items()}


def test_recording_equals_the_log(tmp_path):
    """Rows appended one by one give the same bits as the log made at once."""
    with Recorder(tmp_path / "run", metadata()) as recorder:
        for row in rows_of(arrays()):
            recorder.append(row)
    loaded = Rollout.load(tmp_path / "run")
    assert_same(loaded, rollout())
    assert loaded.metadata.complete
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == ["data", "metadata.yaml"]


def test_rows_may_be_tensors_or_numbers(tmp_path):
    """Tensors, plain numbers and other spellings of keys are the same row."""
    recorder = Recorder(tmp_path / "run", metadata())
    recorder.append({"time": 0.0, ("command", "position"): [0.1, 0.2], ("joint", "position"): (0.0, 1.0)})
    recorder.append(
        {"time": 0.008, "command/position": torch.tensor([0.1, 0.2]), "joint/position": torch.tensor([0, 1])}
    )
    log = recorder.close(fallen=True, travelled_distance=1.5)
    assert log.column("r_knee.position").tolist() == [1, 1]
    assert log.column("l_knee.target") == pytest.approx(0.1)
    assert (log.metadata.fallen, log.metadata.travelled_distance) == (True, 1.5)


def wait_for(condition) -> None:
    """Wait up to 5 s for something that another thread does."""
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def spoilt(**changes):
    """The second row of a log with some channels changed; None removes one."""
    values = list(rows_of(arrays()))[1]
    values.update({tuple(k.split("__")) if "__" in k else k: v for k, v in changes.items()})
    return {key: value for key, value in values.items() if value is not None}


REFUSED = {
    "not finite": (spoilt(joint__velocity=[0.0, np.nan]), "row 2, column r_knee.velocity: nan"),
    "time stands": (spoilt(time=0.0), "row 2, column time: time 0 s does not come after 0 s"),
    "missing": (spoilt(joint__velocity=None), "differ in joint/velocity"),
    "unknown": (spoilt(joint__speed=[0.0, 0.0]), "differ in joint/speed"),
    "gain": (spoilt(command__p_gain=[1.0, -6]), "column r_knee.p_gain: -6 is negative"),
}


@pytest.mark.parametrize("offence", REFUSED)
def test_a_bad_row_is_refused_and_recording_goes_on(tmp_path, offence):
    """A refused row leaves no trace, and the next good one is taken."""
    row, expected = REFUSED[offence]
    good = list(rows_of(arrays(rows=2)))
    recorder = Recorder(tmp_path / "run", metadata())
    recorder.append(good[0])
    with pytest.raises(LogError) as caught:
        recorder.append(row)
    assert expected in str(caught.value)
    recorder.append(good[1])
    assert_same(recorder.close(), rollout(rows=2))


def test_first_row_needs_the_required_channels(tmp_path):
    """A first row without target, or with a misspelt channel, is refused."""
    with Recorder(tmp_path / "run", metadata()) as recorder:
        with pytest.raises(LogError, match="command/position"):
            recorder.append({"time": 0.0, "joint/position": [0, 0]})
        with pytest.raises(LogError, match="unknown channel 'joint/angle'"):
            recorder.append({"time": 0.0, "joint/angle": [0, 0]})
        recorder.append(next(rows_of(arrays())))


def test_an_exception_leaves_an_incomplete_log(tmp_path):
    """When the control loop fails, the rows so far are kept and marked incomplete."""

    def control() -> None:
        with Recorder(tmp_path / "run", metadata()) as recorder:
            for row in rows_of(arrays()):
                recorder.append(row)
            raise TimeoutError("the bus is silent")

    with pytest.raises(TimeoutError):
        control()
    loaded = Rollout.load(tmp_path / "run")
    assert not loaded.metadata.complete
    assert_same(loaded, rollout(complete=False))


def test_empty_and_occupied_folders(tmp_path):
    """A recording without rows leaves nothing; a folder in use is not recorded over."""
    with pytest.raises(LogError, match="no rows were recorded"), Recorder(tmp_path / "run", metadata()):
        pass
    assert list(tmp_path.iterdir()) == []
    rollout().save(tmp_path / "run")
    with pytest.raises(FileExistsError, match="it already exists"):
        Recorder(tmp_path / "run", metadata())
    recorder = Recorder(tmp_path / "other", metadata())
    recorder.append(next(rows_of(arrays())))
    assert recorder.close().rows == 1
    with pytest.raises(LogError, match="closed"):
        recorder.append({})


def test_rows_are_forced_to_the_disk(tmp_path, monkeypatch):
    """The rows file itself is synchronised while recording goes on, with the rows in it."""
    synchronised, fsync = [], os.fsync

    def watched(handle: int) -> None:
        synchronised.append((os.fstat(handle).st_ino, os.fstat(handle).st_size))
        fsync(handle)

    monkeypatch.setattr("op3.rollout.recorder.FLUSH_INTERVAL", 0.05)
    recorder = Recorder(tmp_path / "run", metadata())
    monkeypatch.setattr("op3.rollout.recorder.os.fsync", watched)
    recorder.append(next(rows_of(arrays())))
    number = (tmp_path / "run" / "rows.bin").stat().st_ino
    wait_for(lambda: any(node == number and size > 0 for node, size in synchronised))
    recorder.abandon()


@pytest.mark.parametrize(("damage", "rows"), [("cut", 29), ("page", 27), ("zeros", 30)])
def test_a_torn_end_loses_only_what_is_torn(tmp_path, damage, rows):
    """Rows are read up to the last whole one: half a row, a page that was never written, zeros behind the end."""
    recorder = Recorder(tmp_path / "run", metadata())
    for row in rows_of(arrays()):
        recorder.append(row)
    recorder.abandon()
    file = tmp_path / "run" / "rows.bin"
    raw = file.read_bytes()
    row = (len(raw) - raw.index(b"\n") - 1) // 30
    torn = {"cut": raw[:-100], "page": raw[: -2 * row - 60] + b"\0" * (2 * row + 60), "zeros": raw + b"\0" * 4096}
    file.write_bytes(torn[damage])
    assert Rollout.load(tmp_path / "run").rows == rows


CHILD = """
import itertools, sys, time
import numpy as np
from op3.rollout import Metadata, Recorder
joints = tuple(f"joint_{i}" for i in range(20))
recorder = Recorder(sys.argv[1], Metadata(joints, "emulated", "floor", rate=125))
start = time.monotonic()
for tick in itertools.count(1):
    time.sleep(max(0.0, start + tick / 125 - time.monotonic()))
    target = np.full(20, float(tick) * 1e-4)
    recorder.append({"time": time.monotonic(), ("command", "position"): target, ("joint", "position"): target})
    if tick % 25 == 0:
        print(tick, time.monotonic(), flush=True)
"""


def test_kill_loses_at_most_a_second(tmp_path):
    """A process killed by SIGKILL leaves a log that misses at most the last second and says so."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", CHILD, str(tmp_path / "run")]
    child = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    for line in child.stdout:
        tick, clock = line.split()
        if int(tick) >= 225:
            break
    child.send_signal(signal.SIGKILL)
    child.wait()
    loaded = Rollout.load(tmp_path / "run")
    assert loaded.metadata.complete is False
    assert float(clock) - loaded.column("time")[-1] <= 1.0
    assert loaded.rows >= int(tick) - RATE
    expected = np.arange(1, loaded.rows + 1) * 1e-4
    assert loaded.column("joint_19.position") == pytest.approx(expected, abs=1e-12)


def test_kill_before_the_first_row_is_told(tmp_path):
    """A recording of which nothing reached the disk is refused with that reason."""
    recorder = Recorder(tmp_path / "run", metadata())
    recorder.abandon()
    with pytest.raises(LogError, match="contains no rows"):
        Rollout.load(tmp_path / "run")


def test_appending_is_cheap(tmp_path):
    """A row of 20 joints and all channels takes a small part of an 8 ms tick."""
    joints = tuple(f"joint_{i}" for i in range(20))
    rows = list(rows_of(arrays(rows=2000, joints=20)))
    recorder = Recorder(tmp_path / "run", Metadata(joints, "real", "floor", rate=RATE))
    durations = []
    for row in rows:
        start = time.perf_counter()
        recorder.append(row)
        durations.append(time.perf_counter() - start)
    recorder.close()
    print(f"median append: {np.median(durations) * 1e6:.1f} us")
    assert np.median(durations) < 400e-6  # 5 % of the tick; unloaded machines need a tenth of it
