"""Logs that cannot carry a verdict."""

import numpy as np

from op3.diagnose.preflight import too_poor
from op3.diagnose.split import LogSplit
from op3.rollout import Metadata, Rollout


def log(duration: float, reach: float) -> Rollout:
    """Two joints, of which the second moves by `reach` [rad]."""
    time = np.arange(round(duration * 125)) / 125
    position = np.stack([np.sin(time), reach * np.sin(time)], 1)
    metadata = Metadata(joints=("r_knee", "r_hip_pitch"), robot="simulated", mount="stand", rate=125.0)
    return Rollout.from_arrays({"time": time, "joint/position": position, "command/position": position}, metadata)


def test_short_logs_and_still_joints_are_told():
    """Five seconds in which one joint hardly moves: both are said, with the joint's name."""
    said = too_poor(LogSplit((log(5.0, 0.005),), (), ()))
    assert len(said) == 2
    assert "5 s" in said[0]
    assert "r_hip_pitch" in said[1]
    assert "r_knee" not in said[1]


def test_rich_logs_pass():
    """Twenty seconds with all joints in motion say nothing."""
    assert too_poor(LogSplit((log(20.0, 0.5),), (), ())) == ()
