"""Episodes in HDF5, as ALOHA records them."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from op3.rollout import LogError, read_log, read_logs
from op3.rollout.readers.hdf5 import Hdf5


def test_without_the_package_its_extra_is_named(tmp_path, monkeypatch):
    """As with other formats."""
    path = tmp_path / "episode_0.hdf5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n")
    monkeypatch.setitem(sys.modules, "h5py", None)
    assert Hdf5().claims(path)
    with pytest.raises(LogError, match=r"install it with `pip install 'op3\[hdf5\]'`"):
        read_log(path)


def test_an_episode_of_two_arms(tmp_path):
    """Joints by ALOHA's names, 50 rows per second, and no grippers."""
    h5py = pytest.importorskip("h5py")
    time = np.arange(400)[:, None] / 50
    goal = 0.3 * np.sin(2 * time + np.arange(14))
    angle = 0.29 * np.sin(2 * (time - 0.04) + np.arange(14))
    goal[:, [6, 13]], angle[:, [6, 13]] = 0.5 + goal[:, [6, 13]], 0.5 + angle[:, [6, 13]]
    with h5py.File(tmp_path / "episode_0.hdf5", "w") as file:
        file.attrs["sim"] = False
        file["action"], file["observations/qpos"] = goal, angle
        file["observations/qvel"] = np.gradient(angle, 0.02, axis=0)
        file["observations/images/top"] = np.zeros((400, 4, 4, 3), np.uint8)
    log = read_log(tmp_path / "episode_0.hdf5")
    assert len(log.joints) == 12
    assert log.joints[:2] == ("left_waist", "left_shoulder")
    assert log.metadata.rate == pytest.approx(50)
    assert np.abs(log.array("joint/position")[:, 6] - angle[:, 7]).max() < 1e-9
    assert [one.check for one in log.findings] == ["times"]


@pytest.mark.parametrize("groups", [("data/demo_0/obs", "data/demo_1/obs"), ("follower", "leader")])
def test_arrays_of_one_name_are_of_episodes_or_of_a_leader(tmp_path, groups):
    """Numbered groups are recordings of their own; what a leader measures is the target. Names stand in the file."""
    h5py = pytest.importorskip("h5py")
    time = np.arange(300)[:, None] / 100
    goal, angle = (0.4 * np.sin(3 * (time - late) + np.arange(3)) for late in (0.0, 0.05))
    leads = groups[1] == "leader"
    with h5py.File(tmp_path / "run.hdf5", "w") as file:
        file.attrs["fps"], file.attrs["joint_names"] = 100, ["hip", "knee", "ankle"]
        for number, group in enumerate(groups):
            file[f"{group}/joint_position"] = goal if leads and number else angle * (1 - 0.05 * number)
            if not leads:
                file[group.removesuffix("/obs") + "/actions"] = goal
    logs = read_logs(tmp_path / "run.hdf5")
    assert len(logs) == (1 if leads else 2)
    for number, log in enumerate(logs):
        assert log.joints == ("hip", "knee", "ankle")
        assert np.abs(log.array("command/position") - goal).max() < 1e-9
        assert np.abs(log.array("joint/position") - angle * (1 - 0.05 * number)).max() < 1e-9
