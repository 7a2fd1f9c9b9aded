"""Errors of the trunk's IMU."""

from collections.abc import Mapping

import torch
from torch import Tensor

from op3.servo.effect import Effect, Parameter, Stage, register
from op3.servo.signals import Trunk


@register
class ImuMount(Effect):
    """The IMU is mounted with a rotation: R_imu = Rz(yaw) Ry(pitch) Rx(roll) in the trunk."""

    name = "imu_mount"
    free_base = True
    stage = Stage.SENSING
    equation = "R_measured = R R_imu, w_measured = R_imu' w"
    source = "rigid motion of a board on two screws; range of 3 degrees chosen by us"
    parameters = (
        Parameter("imu_roll", "rad", -0.06, 0.06, 0.0, 0.0, "about the trunk's x axis (forwards)", per_joint=False),
        Parameter("imu_pitch", "rad", -0.06, 0.06, 0.0, 0.0, "about the trunk's y axis (left)", per_joint=False),
        Parameter("imu_yaw", "rad", -0.06, 0.06, 0.0, 0.0, "about the trunk's z axis (upwards)", per_joint=False),
    )
    secants = ({"imu_roll": 0.02}, {"imu_pitch": 0.02}, {"imu_yaw": 0.02})
    fingerprint = "a constant error of the direction of gravity in all poses; rates appear on other axes"
    confounders = ("ground_tilt", "left_right_asymmetry", "com_offset", "gyro_bias")
    separating_experiment = "recordings before and after a turn by 180 degrees: a tilt of the floor changes its sign"

    def sense_trunk(self, trunk: Trunk, values: Mapping[str, Tensor]) -> None:
        turns = [about(axis, values[f"imu_{name}"]) for axis, name in enumerate(("roll", "pitch", "yaw"))]
        mount = product(product(turns[2], turns[1]), turns[0])
        trunk.quaternion = product(trunk.quaternion, mount)
        trunk.angular_velocity = turned_back(trunk.angular_velocity, mount)


@register
class GyroBias(Effect):
    """The gyroscope has a constant bias."""

    name = "gyro_bias"
    free_base = True
    stage = Stage.SENSING
    rank = 1
    equation = "w_measured = w + b"
    source = "MEMS gyroscope before calibration; range of 2 degrees/s chosen by us"
    parameters = (
        Parameter("gyro_bias_x", "rad/s", -0.035, 0.035, 0.0, 0.0, "forwards", per_joint=False),
        Parameter("gyro_bias_y", "rad/s", -0.035, 0.035, 0.0, 0.0, "to the left", per_joint=False),
        Parameter("gyro_bias_z", "rad/s", -0.035, 0.035, 0.0, 0.0, "upwards", per_joint=False),
    )
    secants = ({"gyro_bias_x": 0.01}, {"gyro_bias_y": 0.01}, {"gyro_bias_z": 0.01})
    fingerprint = "a constant rate, even at rest; no torque"
    confounders = ("imu_mount",)
    separating_experiment = "gyroscope readings at rest"

    def sense_trunk(self, trunk: Trunk, values: Mapping[str, Tensor]) -> None:
        bias = torch.cat([values[f"gyro_bias_{axis}"] for axis in "xyz"], -1)
        trunk.angular_velocity = trunk.angular_velocity + bias


def about(axis: int, angle: Tensor) -> Tensor:
    """Quaternion of a turn about an axis: angle ``[sim, 1]`` [rad] to ``[sim, 4]``, w first."""
    parts = [torch.cos(angle / 2), *(torch.zeros_like(angle) for _ in range(3))]
    parts[1 + axis] = torch.sin(angle / 2)
    return torch.cat(parts, -1)


def product(first: Tensor, second: Tensor) -> Tensor:
    """Hamilton product of quaternions ``[..., 4]``, w first."""
    w, x, y, z = first.unbind(-1)
    s, i, j, k = second.unbind(-1)
    return torch.stack(
        [
            w * s - x * i - y * j - z * k,
            w * i + x * s + y * k - z * j,
            w * j - x * k + y * s + z * i,
            w * k + x * j - y * i + z * s,
        ],
        -1,
    )


def turned_back(vector: Tensor, quaternion: Tensor) -> Tensor:
    """A vector ``[..., 3]`` in the frame that the quaternion ``[..., 4]`` turns to."""
    w, axis = quaternion[..., :1], -quaternion[..., 1:]
    axis = axis.expand_as(vector)
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector + w * twice + torch.linalg.cross(axis, twice)
