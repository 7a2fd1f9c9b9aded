"""What one tick reads from the robot, in SI units and as raw counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from op3.deploy.registers import OPEN_CR, OPEN_CR_AXES, XM430_W350
from op3.robot import JOINTS
from op3.settings import read_yaml

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Counts:
    """Registers as they came, sign included; each [joint], and the IMU [9].

    Attributes:
        position: present position.
        velocity: present velocity.
        current: present current.
        voltage: present input voltage.
        temperature: present temperature.
        hardware_error: hardware error status.
        imu: gyro, accelerometer, roll-pitch-yaw.
    """

    position: NDArray[np.int64]
    velocity: NDArray[np.int64]
    current: NDArray[np.int64]
    voltage: NDArray[np.int64]
    temperature: NDArray[np.int64]
    hardware_error: NDArray[np.int64]
    imu: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class State:
    """One tick's reading. Where something did not answer, its last values stand.

    Attributes:
        time: when reading ended [s, clock].
        position: [joint] in rad.
        velocity: [joint] in rad/s.
        current: [joint] in A.
        voltage: [joint] in V.
        temperature: [joint] in C.
        hardware_error: [joint] bits.
        alert: [joint] whether the servo's status packet carried the ALERT bit.
        answered: [joint] whether the servo answered in this tick.
        orientation: [3] roll, pitch, yaw in rad, R = Rz(yaw) Ry(pitch) Rx(roll).
        angular_velocity: [3] in rad/s in the trunk's frame.
        linear_acceleration: [3] specific force in m/s2 in the trunk's frame.
        imu_answered: whether the IMU answered in this tick.
        supply_voltage: at OpenCR [V].
        counts: the same as raw registers.
    """

    time: float
    position: Array
    velocity: Array
    current: Array
    voltage: Array
    temperature: Array
    hardware_error: NDArray[np.int64]
    alert: NDArray[np.bool_]
    answered: NDArray[np.bool_]
    orientation: Array
    angular_velocity: Array
    linear_acceleration: Array
    imu_answered: bool
    supply_voltage: float
    counts: Counts


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is added to a servo's angle to give the joint angle.

    Attributes:
        offset: [joint] in rad.
    """

    offset: Array

    LARGEST = 0.3
    """A larger offset [rad] means a horn mounted on the wrong tooth, not a calibration."""

    def __post_init__(self):
        offset = np.asarray(self.offset, dtype=float)
        object.__setattr__(self, "offset", offset)
        if offset.shape != (len(JOINTS),) or not np.isfinite(offset).all():
            raise ValueError(f"calibration: needs one finite offset [rad] for each of the {len(JOINTS)} joints")
        worst = int(np.abs(offset).argmax())
        if abs(offset[worst]) > self.LARGEST:
            raise ValueError(
                f"calibration: {JOINTS[worst]} is off by {offset[worst]:.3f} rad, more than {self.LARGEST} rad; "
                "check the pose and the mounting of that servo's horn"
            )

    @classmethod
    def none(cls) -> Calibration:
        """All offsets zero."""
        return cls(np.zeros(len(JOINTS)))

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read ``offset_rad: {<joint>: <rad>}``; joints that are not named have no offset."""
        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"there is no calibration file {path}; write one with mode=calibrate")
        offsets = read_yaml(path).get("offset_rad")
        if not isinstance(offsets, Mapping):
            raise ValueError(f"{path}: write `offset_rad:` and below it one line `<joint>: <rad>` per joint")
        for name, value in offsets.items():
            if name not in JOINTS:
                raise ValueError(f"{path}: unknown joint {name!r}; the joints are {', '.join(JOINTS)}")
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise ValueError(f"{path}: the offset of {name} is {value!r}; write a number in rad")
        try:
            return cls(np.array([float(offsets.get(name, 0.0)) for name in JOINTS]))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def save(self, path: str | Path) -> Path:
        """Write the file that `load` reads."""
        path = Path(path)
        offsets = {name: round(float(value), 6) for name, value in zip(JOINTS, self.offset, strict=True)}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump({"offset_rad": offsets}, sort_keys=False), encoding="utf-8")
        return path


def to_state(
    counts: Counts,
    calibration: Calibration,
    *,
    time: float,
    alert: NDArray[np.bool_],
    answered: NDArray[np.bool_],
    imu_answered: bool,
    supply_counts: int,
) -> State:
    """Registers in SI units, in the axes of the joints and of the trunk."""
    gyro, force, angles = counts.imu.reshape(3, 3) * OPEN_CR_AXES
    servo = XM430_W350
    return State(
        time=time,
        position=servo["present_position"].to_si(counts.position) + calibration.offset,
        velocity=servo["present_velocity"].to_si(counts.velocity),
        current=servo["present_current"].to_si(counts.current),
        voltage=servo["present_input_voltage"].to_si(counts.voltage),
        temperature=counts.temperature.astype(float),
        hardware_error=counts.hardware_error,
        alert=alert,
        answered=answered,
        orientation=OPEN_CR["roll"].to_si(angles),
        angular_velocity=OPEN_CR["gyro_x"].to_si(gyro),
        linear_acceleration=OPEN_CR["acceleration_x"].to_si(force),
        imu_answered=imu_answered,
        supply_voltage=OPEN_CR["present_voltage"].to_si(supply_counts),
        counts=counts,
    )
