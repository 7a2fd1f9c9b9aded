"""The readings of one tick: registers, packet layout, SI units and raw counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from op3.common.settings import Named, Number, read_yaml, settings
from op3.deploy.registers import (
    DYNAMIXEL_X,
    FIRST_INDIRECT_DATA,
    OPEN_CR,
    OPEN_CR_AXES,
    POSITION_ZERO,
    Units,
)
from op3.robot import Robot, load_robot
from op3.robot.register_units import ACCELERATION_UNIT, ANGLE_UNIT, GYRO_UNIT, VOLTAGE_UNIT

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

CONTENTS = {
    "current": DYNAMIXEL_X["present_current"],
    "velocity": DYNAMIXEL_X["present_velocity"],
    "position": DYNAMIXEL_X["present_position"],
    "hardware_error": DYNAMIXEL_X["hardware_error_status"],
    "temperature": DYNAMIXEL_X["present_temperature"],
    "voltage": DYNAMIXEL_X["present_input_voltage"],
}
"""Registers that a tick reads from a servo: 14 bytes."""

FIRST_PLAIN = CONTENTS["current"].address
PLAIN_LENGTH = CONTENTS["temperature"].end - FIRST_PLAIN
"""The block that needs no indirect addresses: from present current to present temperature, 21 bytes."""

POINTERS = np.array([at for entry in CONTENTS.values() for at in range(entry.address, entry.end)], "<u2").tobytes()
"""Content of the indirect addresses from `FIRST_INDIRECT_ADDRESS`: the address of each byte of the block."""

_INDIRECT = np.dtype([(name, entry.kind) for name, entry in CONTENTS.items()])
_NEAR = {name: entry for name, entry in CONTENTS.items() if entry.address >= FIRST_PLAIN}
_PLAIN = np.dtype(
    {
        "names": list(_NEAR),
        "formats": [entry.kind for entry in _NEAR.values()],
        "offsets": [entry.address - FIRST_PLAIN for entry in _NEAR.values()],
        "itemsize": PLAIN_LENGTH,
    }
)


@dataclass(frozen=True)
class Block:
    """A block of bytes that one (fast) sync read fetches from each servo.

    Attributes:
        address: address of the first byte.
        length: number of bytes.
        fast: whether the servos answer in one common packet.
        indirect: whether indirect addresses refer to the bytes.
    """

    address: int
    length: int
    fast: bool
    indirect: bool

    def unpack(self, data: Sequence[bytes]) -> dict[str, Counts]:
        """Signed registers by name, each [joint]. A plain block does not contain the hardware error."""
        table = np.frombuffer(b"".join(data), dtype=_INDIRECT if self.indirect else _PLAIN)
        return {name: table[name].astype(np.int64) for name in table.dtype.names or ()}


BLOCKS = (
    Block(FIRST_INDIRECT_DATA, _INDIRECT.itemsize, fast=True, indirect=True),
    Block(FIRST_INDIRECT_DATA, _INDIRECT.itemsize, fast=False, indirect=True),
    Block(FIRST_PLAIN, PLAIN_LENGTH, fast=False, indirect=False),
)
"""Ways to read a tick, best first. The last one needs no setup, and only a sync read."""

BOARD_ADDRESS = OPEN_CR["button"].address
BOARD_LENGTH = OPEN_CR["yaw"].end - BOARD_ADDRESS
"""Registers that a tick reads from an OpenCR: buttons, voltage, gyro, accelerometer, roll-pitch-yaw, 20 bytes."""


@dataclass(frozen=True, eq=False)
class RobotState:
    """The readings of one tick. Devices that did not answer keep their last values. Channels of a missing IMU are None.

    Attributes:
        time: time at which reading ended [s, clock].
        position: [joint] in rad.
        velocity: [joint] in rad/s.
        current: [joint] in A.
        voltage: [joint] in V.
        temperature: [joint] in C.
        alert: [joint] whether the servo's status packet carried the ALERT bit.
        answered: [joint] whether the servo answered in this tick.
        supply_voltage: voltage at the board, or the lowest voltage of the servos [V].
        raw: signed registers as received: the registers in `CONTENTS` [joint], and `imu` [9]: gyro, accelerometer,
            roll-pitch-yaw.
        imu_answered: whether the IMU answered in this tick; None without an IMU.
        orientation: [3] roll, pitch, yaw in rad, R = Rz(yaw) Ry(pitch) Rx(roll).
        angular_velocity: [3] in rad/s in the base's frame.
        linear_acceleration: [3] specific force in m/s2 in the base's frame.
    """

    time: float
    position: Array
    velocity: Array
    current: Array
    voltage: Array
    temperature: Array
    alert: NDArray[np.bool_]
    answered: NDArray[np.bool_]
    supply_voltage: float
    raw: Mapping[str, Counts]
    imu_answered: bool | None = None
    orientation: Array | None = None
    angular_velocity: Array | None = None
    linear_acceleration: Array | None = None

    @classmethod
    def of(
        cls,
        raw: dict[str, Counts],
        units: Units,
        offset: Array,
        board: bytes | None,
        *,
        time: float,
        alert: NDArray[np.bool_],
        answered: NDArray[np.bool_],
        imu_answered: bool,
    ) -> RobotState:
        """Registers of `CONTENTS` in SI units, with `offset` [rad] added to angles, and the board's readings if any."""
        volts, seen = units.voltage * raw["voltage"], {}
        supply = float(volts.min())
        if board is not None:
            supply = VOLTAGE_UNIT * board[OPEN_CR["present_voltage"].address - BOARD_ADDRESS]
            first = OPEN_CR["gyro_x"].address - BOARD_ADDRESS
            imu = np.frombuffer(board, dtype="<i2", offset=first, count=9).astype(np.int64)
            raw = {**raw, "imu": imu}
            gyro, force, angles = imu.reshape(3, 3) * OPEN_CR_AXES
            seen = {
                "orientation": ANGLE_UNIT * angles,
                "angular_velocity": GYRO_UNIT * gyro,
                "linear_acceleration": ACCELERATION_UNIT * force,
                "imu_answered": imu_answered,
            }
        return cls(
            time=time,
            position=(raw["position"] - POSITION_ZERO) * units.position + offset,
            velocity=units.velocity * raw["velocity"],
            current=units.current * raw["current"],
            voltage=volts,
            temperature=raw["temperature"].astype(float),
            alert=alert,
            answered=answered,
            supply_voltage=supply,
            raw=raw,
            **seen,
        )


@settings("calibration")
class CalibrationFile:
    """The content of a calibration file: offsets by joint [rad]."""

    offset_rad: Named[Number]


class Calibration:
    """Offsets that are added to the servos' angles to give joint angles.

    Args:
        offset: offsets [joint] in rad; None: zero.

    Raises:
        ValueError: if an offset is not a number, or so large that the horn must be mounted on the wrong tooth.
    """

    LARGEST = 0.3
    """A larger offset [rad] means a horn mounted on the wrong tooth, not a calibration."""

    def __init__(self, offset: ArrayLike | None = None, *, robot: str | Robot):
        self.robot = load_robot(robot)
        joints = self.robot.joints
        self.offset = np.zeros(len(joints)) if offset is None else np.asarray(offset, dtype=float)
        if self.offset.shape != (len(joints),) or not np.isfinite(self.offset).all():
            raise ValueError(f"calibration: needs one finite offset [rad] for each of the {len(joints)} joints")
        worst = int(np.abs(self.offset).argmax())
        if abs(self.offset[worst]) > self.LARGEST:
            raise ValueError(
                f"calibration: {joints[worst]} is off by {self.offset[worst]:.3f} rad, more than {self.LARGEST} rad; "
                "check the pose and the mounting of that servo's horn"
            )

    @classmethod
    def load(cls, path: str | Path, robot: str | Robot) -> Calibration:
        """Read ``offset_rad: {<joint>: <rad>}``; missing joints have no offset."""
        path, known = Path(path), load_robot(robot)
        if not path.is_file():
            raise FileNotFoundError(f"there is no calibration file {path}; create one with mode=calibrate")
        content = read_yaml(path)
        try:
            offsets = CalibrationFile(**content).offset_rad
            known.indices(offsets)
            return cls([float(offsets.get(name, 0.0)) for name in known.joints], robot=known)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def save(self, path: str | Path) -> Path:
        """Write the file that `load` reads."""
        path = Path(path)
        offsets = {name: round(float(value), 6) for name, value in zip(self.robot.joints, self.offset, strict=True)}
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(yaml.safe_dump({"offset_rad": offsets}, sort_keys=False), encoding="utf-8")
        return path
