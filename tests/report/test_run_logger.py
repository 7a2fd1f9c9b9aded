"""wandb offline: a run folder without account or network, grouped by sweep."""

import time
from pathlib import Path

import pytest

from op3.common.wandb_settings import WandbSettings
from op3.report.run_logger import RunLogger, artifact_name, sweep_group


def test_an_offline_run_is_written_with_group_and_values(tmp_path, monkeypatch, capfd):
    """The run's file holds group, config, values and summary; the film lies beside it; all is quiet."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    film = tmp_path / "film.mp4"
    film.write_bytes(b"frames")
    named = WandbSettings(project="legs", tags=["first"], name="squat-s0")
    with RunLogger(tmp_path / "squats" / "0", config={"budget": 2000}, wandb=named) as logger:
        logger.log({"loss": 0.5}, step=0)
        logger.log({"loss": 0.25}, step=7)
        logger.film("episode", film)
        logger.summary({"error_mrad": 11.5})
    (folder,) = (tmp_path / "squats" / "0" / "wandb").glob("offline-run-*")
    expected = (b"/squats", b"budget", b"2000", b"0.25", b"error_mrad", b"11.5", b"legs", b"first", b"squat-s0")
    record = record_of(tmp_path / "squats" / "0", *expected)
    assert all(part in record for part in expected)
    media = {path.suffix for path in (folder / "files" / "media").rglob("*") if path.is_file()}
    assert media == {".mp4"}
    assert capfd.readouterr() == ("", "")


def record_of(folder: Path, *parts: bytes) -> bytes:
    """The file of a run, once it holds these parts: another process of wandb writes it, late on a busy machine."""
    (path,) = folder.glob("wandb/offline-run-*/*.wandb")
    deadline = time.monotonic() + 30
    while not all(part in path.read_bytes() for part in parts) and time.monotonic() < deadline:
        time.sleep(0.1)
    return path.read_bytes()


def test_what_one_run_made_another_has_read(tmp_path, monkeypatch):
    """A model is the same artifact wherever it lies; every artifact says what it was made from, without an account."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    for name, text in (("log.csv", "1"), ("model.yaml", "2"), ("copy.yaml", "2"), ("policy/manifest.yaml", "3")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    with RunLogger(tmp_path / "identify") as logger:
        logger.lineage([("log", [tmp_path / "log.csv"])], [("model", tmp_path / "model.yaml")])
    with RunLogger(tmp_path / "train") as logger:
        logger.lineage([("model", tmp_path / "copy.yaml")], [("policy", tmp_path / "policy")])
    kinds = {"log": "log.csv", "model": "model.yaml", "policy": "policy/manifest.yaml"}
    names = {kind: artifact_name(kind, [tmp_path / file]).encode() for kind, file in kinds.items()}
    for run, told in (("identify", ("log", "model")), ("train", ("model", "policy"))):
        wanted = [names[kind] for kind in told]
        record = record_of(tmp_path / run, *wanted)
        assert all(name in record for name in wanted)


def test_jobs_of_one_sweep_share_the_group(tmp_path):
    """Numbered folders of one multirun give one group, single runs their own."""
    day = tmp_path / "2026-08-12"
    assert sweep_group(day / "09-21-10" / "0") == sweep_group(day / "09-21-10" / "11") == "2026-08-12/09-21-10"
    assert sweep_group(day / "09-21-10") == "2026-08-12/09-21-10"
    assert sweep_group(day / "09-30-00") != sweep_group(day / "09-21-10")


def test_a_key_that_cannot_be_is_told_in_one_sentence(tmp_path, monkeypatch):
    """Before anything is sent."""
    monkeypatch.setenv("WANDB_API_KEY", "abc")
    with pytest.raises(
        ValueError, match=r"wandb=online: .*API key.*; log in with `wandb login`, or write wandb=offline"
    ):
        RunLogger(tmp_path / "run", wandb=WandbSettings(mode="online"))
