"""Rollouts: what they accept, how they are cut, saved and loaded."""

from __future__ import annotations

import random
import re
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rollout_logs import JOINTS, arrays, assert_same, metadata, rollout
from tensordict import TensorDict

from op3.rollout import CHANNELS, LogError, Metadata, Rollout, column_names, files, read_log, schema_table

finite = st.floats(-6, 6, allow_nan=False, width=64)


@st.composite
def rollouts(draw: st.DrawFn) -> Rollout:
    """Valid logs: any optional channels, any finite numbers, jittered clocks."""
    rows, joints = draw(st.integers(1, 6)), draw(st.integers(1, 3))
    names = tuple(f"joint_{i}" for i in range(joints))
    generator = np.random.default_rng(draw(st.integers(0, 2**32)))
    values = {}
    for key, channel in CHANNELS.items():
        if not channel.required and not draw(st.booleans()):
            continue
        width = {"joint": joints, "imu3": 3, "scalar": 1}.get(channel.axes) or draw(st.integers(1, 3))
        if channel.quantity.binary:
            values[key] = generator.integers(0, 2, (rows, width))
        elif key == "time":
            values[key] = np.cumsum(generator.uniform(0.0078, 0.0082, (rows, 1)), axis=0)
        elif key == ("imu", "linear_acceleration"):
            values[key] = generator.normal([0.0, 0.0, 9.81], 0.1, (rows, width))
        elif key == ("joint", "temperature"):
            values[key] = generator.uniform(20, 60, (rows, width))
        else:
            # angles do not jump from row to row
            scale = 0.05 if channel.quantity.unit == "rad" else min(channel.quantity.bound, 1e3)
            values[key] = generator.uniform(0 if channel.quantity.nonnegative else -scale, scale, (rows, width))
            values[key][0, 0] = draw(st.sampled_from([0.0, 5e-324, 1e-7, 0.1 + 0.2, scale, 1 / 3]))
    about = Metadata(
        names,
        draw(st.sampled_from(["simulated", "real"])),
        "pendulum",
        rate=125,
        mass=draw(st.floats(1e-3, 50)),
        length=0.1,
        seed=draw(st.none() | st.integers()),
        motion=draw(st.none() | st.text(st.characters(codec="utf-8"), min_size=1)),
        extra=draw(st.dictionaries(st.text("abc:# -"), st.floats(allow_nan=False) | st.text("ab:#- \n"))),
    )
    return Rollout.from_arrays(values, about)


def load_error(call, *arguments) -> str:
    """The sentence of the LogError that the call raises."""
    with pytest.raises(LogError) as caught:
        call(*arguments)
    return str(caught.value)


@settings(max_examples=40, deadline=None)
@given(log=rollouts())
def test_folders_and_csv_give_back_the_log(tmp_path_factory, log):
    """A log comes back with the same bits and metadata, and the checks have nothing against it; a file names it."""
    folder = tmp_path_factory.mktemp("log")
    assert_same(Rollout.load(log.save(folder / "run")), log)
    named = Rollout(log.data, log.metadata.replace(recording=log.metadata.recording or "run"))
    assert_same(read_log(log.to_csv(folder / "run.csv")), named)


def test_batch_round_trip_and_episodes(tmp_path):
    """A batch [episode, time] survives saving, and its episodes carry their own outcome."""
    batch = {key: np.stack([a, b]) for (key, a), b in zip(arrays().items(), arrays(seed=1).values(), strict=True)}
    log = Rollout.from_arrays(batch, metadata(fallen=(True, False), travelled_distance=[0.5, 2.0]))
    log.save(tmp_path / "batch")
    loaded = Rollout.load(tmp_path / "batch")
    assert_same(loaded, log)
    second = loaded.episodes()[1]
    assert second.metadata.fallen is False
    assert second.metadata.travelled_distance == 2.0
    assert_same(second, rollout(seed=1, fallen=False, travelled_distance=2.0))


def test_channels_are_named_as_in_the_csv():
    """`column` finds joints, axes and vector entries by their CSV names."""
    log, values = rollout(), arrays()
    assert np.array_equal(log.column("r_knee.position"), values["joint", "position"][:, 1])
    assert np.array_equal(log.column("imu.pitch"), values["imu", "orientation"][:, 1])
    assert np.array_equal(log.column("policy.observation_3"), values["policy", "observation"][:, 3])
    assert "l_knee.speed" in load_error(log.column, "l_knee.speed")


def test_between_keeps_the_rows_of_the_interval():
    """`between` keeps start <= time < end and refuses an empty interval with the log's limits."""
    log = rollout()
    part = log.between(0.08, 0.16)
    assert part.array("time")[:, 0].tolist() == log.array("time")[10:20, 0].tolist()
    assert "0.232 s" in load_error(log.between, 5, 6)


def test_absent_channels_are_absent():
    """A channel that was not given is neither in the data nor readable."""
    values = arrays()
    del values["joint", "current"]
    log = Rollout.from_arrays(values, metadata())
    assert ("joint", "current") not in log
    assert "joint/current" in load_error(log.array, "joint/current")


def test_loading_maps_files_and_never_changes_them(tmp_path):
    """Loaded data is memory-mapped, and writing into it leaves the files as they were."""
    rollout().save(tmp_path / "run")
    loaded = Rollout.load(tmp_path / "run")
    maps = Path("/proc/self/maps")
    if maps.exists():
        assert str(tmp_path / "run" / "data" / "joint" / "position.memmap") in maps.read_text()
    loaded.data["joint", "position"].zero_()
    assert_same(Rollout.load(tmp_path / "run"), rollout())


def test_saved_data_is_a_memory_mapped_tensordict(tmp_path):
    """TensorDict's own loader reads the data folder."""
    rollout().save(tmp_path / "run")
    data = TensorDict.load_memmap(tmp_path / "run" / "data")
    assert torch.equal(data["imu", "orientation"], rollout().data["imu", "orientation"])


NO_SHAPE = '{"position": {"dtype": "torch.float64", "shape": ["nan"]}, "shape": [30]}'


@pytest.mark.parametrize(
    ("file", "content"),
    [("meta.json", "{"), ("joint/meta.json", "{"), ("joint/meta.json", NO_SHAPE), ("time.memmap", "")],
)
def test_broken_folders_are_refused(tmp_path, file, content):
    """A file of the data folder that is garbled or missing is named, and not filled with zeros."""
    rollout().save(tmp_path / "run")
    (tmp_path / "run" / "data" / file).write_text(content)
    assert file in load_error(Rollout.load, tmp_path / "run")
    (tmp_path / "run" / "data" / file).unlink()
    assert file in load_error(Rollout.load, tmp_path / "run")


def test_saving_never_overwrites_unasked(tmp_path):
    """Saving refuses a folder in use, replaces a rollout on demand, and never touches another folder."""
    rollout().save(tmp_path / "run")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        rollout(rows=5).save(tmp_path / "run")
    rollout(rows=5).save(tmp_path / "run", overwrite=True)
    assert Rollout.load(tmp_path / "run").rows == 5
    (tmp_path / "thesis").mkdir()
    with pytest.raises(LogError, match="the folder exists and is not a rollout"):
        rollout().save(tmp_path / "thesis", overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run", "thesis"]


def test_a_failed_save_leaves_nothing(tmp_path, monkeypatch):
    """When writing fails half way, neither the folder nor a temporary one remains."""

    def full_disk(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("op3.rollout.rollout.write_text", full_disk)
    with pytest.raises(OSError, match="No space"):
        rollout().save(tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


SCHEMA_OFFENCES = {
    "dtype": (lambda d: d.set(("joint", "position"), d["joint", "position"].float()), "float32"),
    "unknown channel": (lambda d: d.set(("joint", "speed"), d["joint", "position"]), "speed"),
    "joint axis": (lambda d: d.set(("joint", "current"), torch.zeros(30, 3).double()), r"\[30, 3\]"),
    "not finite": (lambda d: d["imu", "orientation"][7].fill_(torch.inf), "row 8, column imu.roll: inf"),
    "missing": (lambda d: d.del_(("command", "position")), "l_knee.target"),
    "time": (lambda d: d["time"][4].fill_(0.0), "row 5, column time"),
    "negative gain": (lambda d: d["command", "p_gain"][2, 1].fill_(-1), "row 3, column r_knee.p_gain: -1"),
}


@pytest.mark.parametrize("offence", SCHEMA_OFFENCES)
def test_a_rollout_cannot_be_made_of_bad_data(offence):
    """Every offence against the schema is refused when the rollout is made."""
    change, expected = SCHEMA_OFFENCES[offence]
    data = rollout().data.clone()
    change(data)
    assert re.search(expected, load_error(Rollout, data, metadata()))


def test_errors_of_a_batch_name_the_episode():
    """In a batch the sentence also names the episode."""
    batch = {key: np.stack([a, a]) for key, a in arrays().items()}
    batch["joint", "velocity"][1, 3, 0] = np.nan
    assert "episode 1, row 4, column l_knee.velocity: nan" in load_error(Rollout.from_arrays, batch, metadata())


def test_no_rows_are_refused():
    """A log without rows is not a log."""
    empty = {key: value[:0] for key, value in arrays().items()}
    assert "at least one row" in load_error(Rollout.from_arrays, empty, metadata())


def test_spikes_of_an_impact_are_no_unit_mistake():
    """A fall's acceleration spike passes the unit check."""
    values = arrays()
    values["imu", "linear_acceleration"][10] = [900.0, -300.0, 2000.0]
    Rollout.from_arrays(values, metadata()).check()


@pytest.mark.parametrize(
    "steps",
    [
        [0.008] * 24 + [0.1] * 5,  # a few long gaps: the median interval is right, the mean is not
        [0.004, 0.004, 0.016] * 10,  # two alternating intervals: the mean is right, the median is not
    ],
)
def test_gaps_and_alternating_intervals_keep_the_rate(steps):
    """A clock whose median or mean interval agrees with the rate is accepted."""
    values = arrays(rows=len(steps))
    values["time"] = np.cumsum(steps)[:, None]
    del values["joint", "velocity"]
    Rollout.from_arrays(values, metadata()).check()


def test_the_table_describes_every_channel():
    """Column names are unique, and every channel has one line in the printed table."""
    names = [name for channel in CHANNELS.values() for name in column_names(channel, JOINTS, 2)]
    assert len(names) == len(set(names))
    assert len(schema_table().splitlines()) == len(CHANNELS) + 2


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (dict(robot="op4"), "field robot: 'op4'"),
        (dict(rate=0), "field rate: 0 is not a positive number"),
        (dict(joints="l_knee"), "field joints: 'l_knee' is not a list"),
        (dict(joints=["l_knee", "l_knee"]), "listed twice"),
        (dict(joints=["imu"]), "field joints: 'imu'"),
        (dict(extra={"a": object()}), "field extra"),
        (dict(mass=-1.0), "field mass: -1.0"),
    ],
)
def test_metadata_refuses(change, expected):
    """Each wrong field is named with its value and what belongs there."""
    assert expected in load_error(lambda: metadata(**change))


def test_metadata_takes_numpy_and_arrays():
    """Numbers from numpy and torch become plain values that YAML can write."""
    about = metadata(
        rate=np.float64(125),
        seed=np.int64(3),
        fallen=np.array([True, False]),
        episode_duration=torch.tensor([1.0, 2.5]),
        extra={"scale": np.float32(0.5), "range": (1, 2)},
    )
    assert about.fallen == (True, False)
    assert about.episode_duration == (1.0, 2.5)
    assert Metadata.from_dict(about.to_dict()) == about
    assert about.extra == {"scale": 0.5, "range": [1, 2]}


def test_of_two_that_save_at_once_one_is_refused(tmp_path, monkeypatch):
    """What another process has saved meanwhile stays as it is."""
    mine, its, save = rollout(seed=1), rollout(seed=2), files.save_tensordict

    def slow(data, folder):
        monkeypatch.setattr(files, "save_tensordict", save)
        its.save(tmp_path / "run")
        save(data, folder)

    monkeypatch.setattr(files, "save_tensordict", slow)
    monkeypatch.setattr(
        "op3.common.writing._temporary", lambda path: path.with_name(f".{path.name}.{random.random()}.tmp")
    )
    with pytest.raises(FileExistsError, match="it already exists"):
        mine.save(tmp_path / "run")
    assert_same(Rollout.load(tmp_path / "run"), its)
    assert [file.name for file in tmp_path.iterdir()] == ["run"]


def test_a_full_disk_leaves_nothing(tmp_path):
    """The system's own error says so; a limit of the size of files stands for the disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            rollout().save(tmp_path / "run")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())
