"""wandb offline: a run folder without account or network, grouped by sweep."""

import time

import numpy as np
import plotly.graph_objects as go
import pytest

from op3.report import RunLogger, sweep_group


def test_an_offline_run_is_written_with_group_and_values(tmp_path, monkeypatch, capfd):
    """The run's file holds group, name, config, values and summary; figure and image lie beside it; all is quiet."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    with RunLogger(tmp_path / "sweep" / "0", group="squat-sweep", name="job-0", config={"budget": 2000}) as logger:
        logger.log({"loss": 0.5}, step=0)
        logger.log({"loss": 0.25}, step=7)
        logger.figure("history", go.Figure(go.Scatter(y=[1, 2])))
        logger.image("frame", np.zeros((4, 6, 3), dtype=np.uint8))
        logger.summary({"error_mrad": 11.5})
    (folder,) = (tmp_path / "sweep" / "0" / "wandb").glob("offline-run-*")
    assert logger.folder is not None
    assert logger.folder.resolve() == folder.resolve()
    (record,) = folder.glob("*.wandb")
    expected = (b"squat-sweep", b"job-0", b"budget", b"2000", b"0.25", b"error_mrad", b"11.5")
    deadline = time.monotonic() + 30  # another process of wandb writes the file, late on a busy machine
    while not all(part in record.read_bytes() for part in expected) and time.monotonic() < deadline:
        time.sleep(0.1)
    for part in expected:
        assert part in record.read_bytes()
    media = {path.suffix for path in (folder / "files" / "media").rglob("*") if path.is_file()}
    assert media == {".json", ".png"}
    assert capfd.readouterr() == ("", "")


def test_jobs_of_one_sweep_share_the_group(tmp_path):
    """Numbered folders of one multirun give one group, single runs their own."""
    day = tmp_path / "2026-08-12"
    assert sweep_group(day / "09-21-10" / "0") == sweep_group(day / "09-21-10" / "11") == "2026-08-12/09-21-10"
    assert sweep_group(day / "09-21-10") == "2026-08-12/09-21-10"
    assert sweep_group(day / "09-30-00") != sweep_group(day / "09-21-10")


def test_an_unknown_mode_is_refused(tmp_path):
    """A misspelt mode is named before anything is written."""
    with pytest.raises(ValueError, match="wandb mode 'of': choose offline, online or disabled"):
        RunLogger(tmp_path / "run", mode="of")
    assert not (tmp_path / "run").exists()


def test_disabled_writes_nothing(tmp_path):
    """A disabled logger takes everything and leaves no files."""
    with RunLogger(tmp_path / "run", mode="disabled") as logger:
        logger.log({"loss": 1.0})
    assert list((tmp_path / "run").iterdir()) == []
