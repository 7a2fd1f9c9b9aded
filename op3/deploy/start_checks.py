"""Checks before torque is switched on. They only read, except that they may switch on the servos' supply."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from op3.common.doctor import ADAPTERS, LATENCY, latency_timer
from op3.deploy.dynamixel_bus import BOARD, SLOW_ANSWER, Bus, BusError, NoAnswer, Writer
from op3.deploy.limits import Limits
from op3.deploy.registers import OPEN_CR_MODEL, HardwareError
from op3.deploy.robot_state import RobotState
from op3.robot.register_units import VOLTAGE_UNIT
from op3.robot.self_collision import SelfCollision

POWER_UP_TIME = 0.5
"""Time that servos need to start after their supply is switched on [s]."""

LEAST_FIRMWARE = 38
"""First firmware of the XM430 with the bus watchdog; ROBOTIS e-Manual."""

LONGEST_RETURN_DELAY = 1
"""Longest return delay [2 us]: with the factory value, 500 us, twenty answers do not fit into a tick."""

UNTOUCHED = {
    "drive_mode": 0,
    "homing_offset": 0,
    "pwm_limit": 885,
    "profile_velocity": 0,
    "profile_acceleration": 0,
    "shutdown": 0x34,  # on overheating, electrical shock and overload
}
"""Registers that other programs change, with their factory values; ROBOTIS e-Manual."""

LARGEST_TILT_DEG = 30.0
"""An upright trunk rolls and pitches less than this [deg]; the squat leans by 17."""

MARGIN = 0.05
"""Largest angle of a joint without torque beyond its soft limit [rad]."""

LATE_ANSWER = 2.5
"""Median time of a ping with a latency timer of 1 ms is below this [ms]: wire and computer add 0.3."""

SAMPLES = 25
"""Readings of the IMU that must not all be the same, one every 8 ms."""


@dataclass(frozen=True)
class Check:
    """The result of one check, with the remedy if it failed."""

    name: str
    ok: bool
    detail: str

    def __str__(self) -> str:
        return f"{'ok  ' if self.ok else 'FAIL'} {self.name}: {self.detail}"


class Failed(Exception):
    """A check failed; the message states the problem and the remedy."""


class StartChecks:
    """The checks in order; the first failure ends them, because later checks depend on earlier ones.

    Each check returns its result as text, or raises `Failed`.

    Args:
        writer: write handle, used only to switch on the servos' supply; None if this is not allowed.
        report: function that receives each completed check.
    """

    def __init__(self, bus: Bus, writer: Writer | None, limits: Limits, report: Callable[[Check], None]):
        self._bus, self._writer, self._limits, self._report = bus, writer, limits, report
        self._joints, self._models = bus.joints, {}

    def run(self) -> Check:
        """Run the checks; a failed check is the last in the list."""
        return self._run(
            ("latency timer", self._latency_timer),
            ("servo power", self._power),
            ("ping", self._ping),
            ("models and firmware", self._firmware),
            ("return delay", self._return_delay),
            ("status return level", self._return_level),
            *((register.replace("_", " "), partial(self._untouched, register)) for register in UNTOUCHED),
            ("servo limits", self._servo_limits),
            ("hardware errors", self._hardware_errors),
            ("temperature", self._temperature),
            ("supply voltage", self._voltage),
            ("joint angles", self._angles),
            ("self-collision", self._parts),
            *([("IMU", self._imu)] if self._bus.board else []),
        )

    def run_power(self) -> Check:
        """Only the checks that are required for writing."""
        return self._run(("servo power", self._power), ("ping", self._ping))

    def _run(self, *checks: tuple[str, Callable[[], str]]) -> Check:
        for name, check in checks:
            try:
                result = Check(name, True, check())
            except (Failed, BusError) as error:
                result = Check(name, False, str(error))
            self._report(result)
            if not result.ok:
                break
        return result

    def _latency_timer(self) -> str:
        file, value = latency_timer(self._bus.port_name, ADAPTERS)
        if value is None:
            return "no USB serial adapter with a latency timer"
        if value > LATENCY:
            raise Failed(f"{value} ms makes a tick take 15 to 20 ms; run echo {LATENCY} | sudo tee {file}")
        return f"{value} ms"

    def _power(self) -> str:
        bus = self._bus
        first = BOARD if bus.board else self._joints[0]
        try:
            bus.ping(first)
        except NoAnswer:
            with bus.patience(SLOW_ANSWER, SLOW_ANSWER):
                try:
                    bus.ping(first)
                except NoAnswer:
                    self._look_for_protocol_1([first])
                    raise
            self._blame_adapter()
            raise
        if not bus.board or bus.read(BOARD, "dynamixel_power"):
            return "on"
        if self._writer is None:
            remedy = "press the robot's power button or use a mode that may switch it on"
            raise Failed(f"the servos' supply is off; {remedy}")
        self._writer.write(BOARD, "dynamixel_power", 1)
        bus.clock.sleep_until(bus.clock.now() + POWER_UP_TIME)
        if not bus.read(BOARD, "dynamixel_power"):
            raise Failed("the supply is still off after it was switched on; check the board")
        return "switched on"

    def _blame_adapter(self) -> None:
        """Report late answers first: a device that answers late is not faulty."""
        bus, waits = self._bus, []
        with bus.patience(SLOW_ANSWER, SLOW_ANSWER):
            for _ in range(9):
                began = bus.clock.now()
                bus.ping(BOARD if bus.board else self._joints[0])
                waits.append(1e3 * (bus.clock.now() - began))
        port, late = Path(bus.port_name).name, float(np.median(waits))
        if late > LATE_ANSWER:
            raise Failed(
                f"answers come after {late:.0f} ms: the USB adapter's latency timer has this value and must be 1 ms;"
                f" run echo 1 | sudo tee {ADAPTERS}/{port}/latency_timer, or setserial /dev/{port} low_latency"
            )

    def _ping(self) -> str:
        self._models = self._bus.ping_all()
        if missing := [name for name in self._bus.ids if name not in self._models]:
            self._look_for_protocol_1(missing)
            devices = ", ".join(f"{name} (id {self._bus.ids[name]})" for name in missing)
            raise Failed(f"no answer from {devices}; check cables, power and ids, and set all devices to 2 Mbps")
        return f"{len(self._joints)} servos{' and OpenCR' if self._bus.board else ''} answer"

    def _look_for_protocol_1(self, silent: Sequence[str]) -> None:
        if old := [f"{name} (id {self._bus.ids[name]})" for name in silent if self._bus.answers_protocol_1(name)]:
            remedy = "set their register protocol_version to 2 with DYNAMIXEL Wizard"
            raise Failed(f"protocol 1.0 answer from {', '.join(old)}; {remedy}")

    def _firmware(self) -> str:
        for name, model in self._models.items():
            wanted = OPEN_CR_MODEL if name == BOARD else self._bus.units.models[name]
            if model != wanted:
                raise Failed(f"{name} is model {model}, expected {wanted}")
        if old := self._where("firmware_version", lambda version: version < LEAST_FIRMWARE):
            raise Failed(f"firmware without bus watchdog: {old}; update to {LEAST_FIRMWARE} or later")
        found = sorted(set(self._all("firmware_version").values()))
        return f"models match the robot file; firmware {', '.join(map(str, found))}"

    def _return_delay(self) -> str:
        if slow := self._where(
            "return_delay_time", lambda value: value > LONGEST_RETURN_DELAY, lambda v: f"{2 * v} us"
        ):
            raise Failed(f"too long: {slow}; write it once with mode=setup")
        return f"at most {2 * LONGEST_RETURN_DELAY} us"

    def _return_level(self) -> str:
        if wrong := [name for name, value in self._all("status_return_level").items() if value != 2]:
            raise Failed(f"{', '.join(wrong)} do not answer every packet; switch the power off and on")
        return "every packet is answered"

    def _untouched(self, register: str) -> str:
        # A reversed servo drives away from its target; an offset moves its zero.
        allowed = self._limits.homing_offset if register == "homing_offset" else 0
        away = {name: value - UNTOUCHED[register] for name, value in self._all(register).items()}
        odd = self._where(register, lambda value: abs(value - UNTOUCHED[register]) > allowed)
        if not odd:
            return "normal"
        text, remedy = f"unexpected values: {odd}", "write it once with mode=setup, then calibrate"
        if register == "homing_offset":
            name, worst = max(away.items(), key=lambda item: abs(item[1]))
            angle = worst * self._bus.units.position[self._joints.index(name)]
            text += f" (up to {angle:+.2f} rad), set by another program"
            remedy += f", or keep the offset with limits.homing_offset={abs(worst)} and calibrate"
        raise Failed(f"{text}; {remedy}")

    def _servo_limits(self) -> str:
        """The run must end before a servo switches itself off."""
        limits = self._limits
        if cool := self._where("temperature_limit", lambda value: value <= limits.temperature, "{} C".format):
            raise Failed(
                f"{cool}: a servo would shut down before the run ends at {limits.temperature:g} C;"
                " raise its register temperature_limit, or lower limits.temperature"
            )
        if high := self._where("min_voltage_limit", lambda v: VOLTAGE_UNIT * v > limits.voltage + 1e-9, _volts):
            raise Failed(
                f"{high}: a servo would report an error before the run ends at {limits.voltage:g} V;"
                " lower its register min_voltage_limit, or raise limits.voltage"
            )
        return f"beyond {limits.temperature:g} C and {limits.voltage:g} V"

    def _temperature(self) -> str:
        warm = self._all("present_temperature")
        name = max(warm, key=lambda key: warm[key])
        detail = f"{warm[name]} C at {name}, the highest"
        if warm[name] >= self._limits.temperature:
            raise Failed(f"{detail}; let it cool")
        return detail

    def _hardware_errors(self) -> str:
        if causes := self._where("hardware_error_status", bool, lambda value: f"({HardwareError.describe(value)})"):
            raise Failed(f"{causes}; remove the cause, then switch the power off and on")
        return "none"

    def _voltage(self) -> str:
        least, counts = self._limits.start_voltage, self._all("present_input_voltage")
        if self._bus.board:
            counts[BOARD] = self._bus.read(BOARD, "present_voltage")
        name = min(counts, key=lambda key: counts[key])
        detail = f"{_volts(counts[name])} at {name}, the lowest"
        if VOLTAGE_UNIT * counts[name] < least - 1e-9:
            raise Failed(f"{detail}; charge to at least {least} V")
        return detail

    def _angles(self) -> str:
        position, (low, high) = self._read().position, self._bus.robot.limits.T
        outside = np.maximum(low - position, position - high)
        worst = int(outside.argmax())
        if outside[worst] > MARGIN:
            raise Failed(
                f"{self._joints[worst]} is at {position[worst]:.2f} rad, outside its soft limits"
                f" [{low[worst]:.2f}, {high[worst]:.2f}]; move it inside by hand, or check its calibration and horn"
            )
        return "inside the soft limits"

    def _parts(self) -> str:
        position, largest = self._read().position, self._limits.overlap
        if gap := SelfCollision(self._bus.robot, margin=0.0).measured(position, 0.0 * position, largest):
            raise Failed(f"{gap}; move them apart by hand, or check the joints' calibration and horns")
        return f"no parts overlap by more than {1000 * largest:g} mm"

    def _imu(self) -> str:
        bus, blocks = self._bus, set()
        for _ in range(SAMPLES):
            state = bus.read_state()
            if state.imu_answered:
                blocks.add(state.raw["imu"].tobytes())
            bus.clock.sleep_until(bus.clock.now() + 0.008)
        if len(blocks) < 2:
            self._blame_adapter()
            raise Failed(f"{SAMPLES} readings contain only {len(blocks)} different block; switch the power off and on")
        assert state.orientation is not None
        assert state.linear_acceleration is not None
        (roll, pitch), force = np.rad2deg(state.orientation[:2]), state.linear_acceleration
        # The direction of gravity from the accelerometer, with which the attitude filter must agree.
        felt = np.rad2deg([np.arctan2(force[1], force[2]), np.arctan2(-force[0], np.hypot(force[1], force[2]))])
        detail = f"roll {round(roll)} deg, pitch {round(pitch)} deg, alive"
        if max(abs(roll), abs(pitch)) > LARGEST_TILT_DEG:
            raise Failed(f"{detail}; put the robot upright")
        if np.abs(felt - (roll, pitch)).max() > 10:
            raise Failed(
                f"{detail}, but the accelerometer indicates {felt[0]:.0f} and {felt[1]:.0f} deg;"
                " keep the robot still, or calibrate OpenCR's IMU"
            )
        return detail

    def _read(self) -> RobotState:
        """A reading after every device has answered at least once."""
        heard = np.zeros(len(self._joints), dtype=bool)
        for _ in range(10):
            state = self._bus.read_state()
            heard |= state.answered
            if heard.all():
                return state
        self._blame_adapter()
        silent = ", ".join(self._joints[i] for i in np.flatnonzero(~heard))
        raise BusError(f"no answer from {silent} to ten readings")

    def _all(self, register: str) -> dict[str, int]:
        """One register of all servos; servos missed by the sync read are read individually."""
        values = self._bus.sync_read(register)
        return {name: values[name] if name in values else self._bus.read(name, register) for name in self._joints}

    def _where(self, register: str, wrong: Callable[[int], bool], shown: Callable[[int], str] = str) -> str:
        """The servos with a wrong register and its values, as text; empty if there are none."""
        return ", ".join(f"{name} {shown(value)}" for name, value in self._all(register).items() if wrong(value))


def _volts(counts: int) -> str:
    return f"{VOLTAGE_UNIT * counts:.1f} V"
