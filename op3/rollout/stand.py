"""How the stand held the robot while a log was recorded."""

from op3.rollout.rollout import Rollout


def stand_tilt(log: Rollout) -> tuple[float, float] | None:
    """Roll and pitch of the stand [rad], to a hundredth: by the IMU, else the ``tilt`` of the metadata's ``extra``.

    Returns:
        None where neither tells.
    """
    if "imu/orientation" in log:
        roll, pitch = log.array("imu/orientation")[:, :2].mean(0)
    elif "tilt" in log.metadata.extra:
        roll, pitch = log.metadata.extra["tilt"]
    else:
        return None
    return round(float(roll), 2) + 0.0, round(float(pitch), 2) + 0.0
