"""What has to be true before any torque. Every check only reads, but for switching on the servos' supply."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from op3.deploy.dynamixel_bus import BOARD, FIRST_ANSWER, SLOW_ANSWER, Bus, BusError, NoAnswer, Writer
from op3.deploy.limits import Limits
from op3.deploy.registers import OPEN_CR_MODEL, HardwareError
from op3.deploy.state import State
from op3.doctor import ADAPTERS, LATENCY, latency_timer
from op3.robot.units import VOLTAGE_UNIT

POWER_UP_TIME = 0.5
"""How long servos take to start after their supply is switched on [s]."""

LEAST_FIRMWARE = 38
"""First firmware of the XM430 with the bus watchdog; ROBOTIS e-Manual."""

LONGEST_RETURN_DELAY = 1
"""In units of 2 us: with the factory value, 500 us, twenty answers do not fit into a tick."""

UNTOUCHED = {
    "drive_mode": 0,
    "homing_offset": 0,
    "pwm_limit": 885,
    "profile_velocity": 0,
    "profile_acceleration": 0,
}
"""Registers that other programs leave behind, and their values from the factory; ROBOTIS e-Manual."""

LARGEST_TILT_DEG = 30.0
"""An upright trunk rolls and pitches less than this [deg]; the squat leans by 17."""

MARGIN = 0.05
"""How far a limp joint may hang beyond its soft limit [rad]."""

SAMPLES = 25
"""Readings of the IMU that must not all be the same, one every 8 ms."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check.

    Attributes:
        name: what was checked.
        ok: whether it passed.
        detail: what was found, and the remedy where it did not pass.
    """

    name: str
    ok: bool
    detail: str

    def __str__(self) -> str:
        return f"{'ok  ' if self.ok else 'FAIL'} {self.name}: {self.detail}"


class StartChecks:
    """The checks in their order; the first that fails ends them, since later ones rely on it.

    Args:
        bus: to read from.
        writer: switches on the servos' supply and nothing else; None where that must not happen either.
        limits: voltages.
        sysfs: where the kernel shows serial adapters.
    """

    def __init__(self, bus: Bus, writer: Writer | None, limits: Limits, *, sysfs: Path = ADAPTERS):
        self._bus, self._writer, self._limits, self._sysfs = bus, writer, limits, sysfs
        self._joints, self._models = bus.joints, {}

    def run(self, report: Callable[[Check], None] | None = None) -> list[Check]:
        """Run the checks; each is reported as it is made."""
        return self._run(
            report,
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
            *([("IMU", self._imu)] if self._bus.board else []),
        )

    def run_power(self, report: Callable[[Check], None] | None = None) -> list[Check]:
        """Only the checks without which nothing can be written."""
        return self._run(report, ("servo power", self._power), ("ping", self._ping))

    def _run(
        self, report: Callable[[Check], None] | None, *checks: tuple[str, Callable[[], tuple[bool, str]]]
    ) -> list[Check]:
        results = []
        for name, check in checks:
            try:
                ok, detail = check()
            except BusError as error:
                ok, detail = False, str(error)
            results.append(Check(name, ok, detail))
            if report is not None:
                report(results[-1])
            if not ok:
                break
        return results

    def _latency_timer(self) -> tuple[bool, str]:
        file, value = latency_timer(str(getattr(self._bus.port, "port_name", "")), self._sysfs)
        if value is None:
            return True, "no USB serial adapter with a latency timer"
        if value <= LATENCY:
            return True, f"{value} ms"
        return False, f"{value} ms makes a tick take 15 to 20 ms; echo {LATENCY} | sudo tee {file}"

    def _power(self) -> tuple[bool, str]:
        bus = self._bus
        first = BOARD if bus.board else self._joints[0]
        try:
            bus.ping(first)
        except NoAnswer:
            with bus.patience(SLOW_ANSWER, SLOW_ANSWER):
                bus.ping(first)
            port = Path(str(getattr(bus.port, "port_name", "ttyUSB0"))).name
            return False, (
                f"answers come only after {FIRST_ANSWER:g} ms: the USB adapter's latency timer is about 16 ms and must"
                f" be 1; echo 1 | sudo tee {self._sysfs}/{port}/latency_timer, or setserial /dev/{port} low_latency"
            )
        if not bus.board or bus.read(BOARD, "dynamixel_power"):
            return True, "on"
        if self._writer is None:
            return (
                False,
                "the servos' supply is off; press the robot's power button or use a mode that may switch it on",
            )
        self._writer.write(BOARD, "dynamixel_power", 1)
        bus.clock.sleep_until(bus.clock.now() + POWER_UP_TIME)
        return bool(bus.read(BOARD, "dynamixel_power")), "switched on"

    def _ping(self) -> tuple[bool, str]:
        self._models = self._bus.ping_all()
        missing = [f"{name} (id {self._bus.ids[name]})" for name in self._bus.ids if name not in self._models]
        if missing:
            remedy = "check cables, power, ids, and that all are at 2 Mbps and speak protocol 2.0"
            return False, f"no answer from {', '.join(missing)}; {remedy}"
        return True, f"{len(self._joints)} servos{' and OpenCR' if self._bus.board else ''} answer"

    def _firmware(self) -> tuple[bool, str]:
        for name, model in self._models.items():
            wanted = OPEN_CR_MODEL if name == BOARD else self._bus.units.models[name]
            if model != wanted:
                return False, f"{name} is model {model}, expected {wanted}"
        versions = self._all("firmware_version")
        old = [f"{name} {version}" for name, version in versions.items() if version < LEAST_FIRMWARE]
        if old:
            return False, f"firmware without bus watchdog: {', '.join(old)}; update to {LEAST_FIRMWARE} or later"
        found = sorted(set(versions.values()))
        return True, f"as in the robot's file, with firmware {', '.join(map(str, found))}"

    def _return_delay(self) -> tuple[bool, str]:
        values = self._all("return_delay_time")
        slow = [f"{name} {2 * value} us" for name, value in values.items() if value > LONGEST_RETURN_DELAY]
        if slow:
            return False, f"too long: {', '.join(slow)}; write it once with mode=setup"
        return True, f"at most {2 * LONGEST_RETURN_DELAY} us"

    def _return_level(self) -> tuple[bool, str]:
        wrong = [name for name, value in self._all("status_return_level").items() if value != 2]
        if wrong:
            return False, f"{', '.join(wrong)} do not answer every packet; switch the power off and on"
        return True, "every packet is answered"

    def _untouched(self, register: str) -> tuple[bool, str]:
        # A reversed servo turns every correction into a push the wrong way; an offset moves its zero.
        normal = UNTOUCHED[register]
        allowed = self._limits.homing_offset if register == "homing_offset" else 0
        odd = {name: value for name, value in self._all(register).items() if abs(value - normal) > allowed}
        if not odd:
            return True, "normal"
        text = f"not normal: {', '.join(f'{name} {value}' for name, value in odd.items())}"
        if register == "homing_offset":
            name, worst = max(odd.items(), key=lambda item: abs(item[1]))
            angle = worst * self._bus.units.position[self._joints.index(name)]
            text += f" (up to {angle:+.2f} rad), left behind by another program"
            remedy = f"or keep it with limits.homing_offset={abs(worst)} and calibrate with it"
            return False, f"{text}; write it once with mode=setup, then calibrate, {remedy}"
        return False, f"{text}; write it once with mode=setup, then calibrate"

    def _servo_limits(self) -> tuple[bool, str]:
        """The run has to end before a servo lets go by itself."""
        limits = self._limits
        cool = [
            f"{name} {value} C" for name, value in self._all("temperature_limit").items() if value <= limits.temperature
        ]
        if cool:
            return False, (
                f"{', '.join(cool)}: a servo would shut down before the run ends at {limits.temperature:g} C;"
                " raise its register temperature_limit, or lower limits.temperature"
            )
        volts = {name: VOLTAGE_UNIT * value for name, value in self._all("min_voltage_limit").items()}
        high = [f"{name} {value:.1f} V" for name, value in volts.items() if value > limits.voltage + 1e-9]
        if high:
            return False, (
                f"{', '.join(high)}: a servo would report an error before the run ends at {limits.voltage:g} V;"
                " lower its register min_voltage_limit, or raise limits.voltage"
            )
        return True, f"beyond {limits.temperature:g} C and {limits.voltage:g} V"

    def _temperature(self) -> tuple[bool, str]:
        warm = self._all("present_temperature")
        name = max(warm, key=lambda key: warm[key])
        detail = f"{warm[name]} C at {name}, the highest"
        return (True, detail) if warm[name] < self._limits.temperature else (False, f"{detail}; let it cool")

    def _hardware_errors(self) -> tuple[bool, str]:
        errors = {name: value for name, value in self._all("hardware_error_status").items() if value}
        if errors:
            causes = ", ".join(f"{name} ({HardwareError.describe(value)})" for name, value in errors.items())
            return False, f"{causes}; mend the cause, then switch the power off and on"
        return True, "none"

    def _voltage(self) -> tuple[bool, str]:
        least = self._limits.start_voltage
        volts = {name: VOLTAGE_UNIT * value for name, value in self._all("present_input_voltage").items()}
        if self._bus.board:
            volts[BOARD] = VOLTAGE_UNIT * self._bus.read(BOARD, "present_voltage")
        name = min(volts, key=lambda key: volts[key])
        detail = f"{volts[name]:.1f} V at {name}, the lowest"
        return (True, detail) if volts[name] >= least - 1e-9 else (False, f"{detail}; charge to at least {least} V")

    def _angles(self) -> tuple[bool, str]:
        position, (low, high) = self._read().position, self._bus.robot.limits.T
        outside = np.maximum(low - position, position - high)
        worst = int(outside.argmax())
        if outside[worst] > MARGIN:
            return False, (
                f"{self._joints[worst]} is at {position[worst]:.2f} rad, outside its soft limits"
                f" [{low[worst]:.2f}, {high[worst]:.2f}]; move it by hand, or check its calibration and horn"
            )
        return True, "inside the soft limits"

    def _imu(self) -> tuple[bool, str]:
        bus, blocks = self._bus, set()
        for _ in range(SAMPLES):
            state = bus.read_state()
            if state.imu_answered:
                blocks.add(state.raw["imu"].tobytes())
            bus.clock.sleep_until(bus.clock.now() + 0.008)
        if len(blocks) < 2:
            return False, f"{SAMPLES} readings hold {len(blocks)} different block; switch the power off and on"
        assert state.orientation is not None
        assert state.linear_acceleration is not None
        (roll, pitch), force = np.rad2deg(state.orientation[:2]), state.linear_acceleration
        # Where gravity points, from the accelerometer alone; the attitude filter must agree with it.
        felt = np.rad2deg([np.arctan2(force[1], force[2]), np.arctan2(-force[0], np.hypot(force[1], force[2]))])
        detail = f"roll {round(roll)} deg, pitch {round(pitch)} deg, alive"
        if max(abs(roll), abs(pitch)) > LARGEST_TILT_DEG:
            return False, f"{detail}; put the robot upright"
        if np.abs(felt - (roll, pitch)).max() > 10:
            return False, (
                f"{detail}, but the accelerometer says {felt[0]:.0f} and {felt[1]:.0f} deg;"
                " keep the robot still, or calibrate OpenCR's IMU"
            )
        return True, detail

    def _read(self) -> State:
        """A reading to which everything has answered at some time."""
        heard = np.zeros(len(self._joints), dtype=bool)
        for _ in range(10):
            state = self._bus.read_state()
            heard |= state.answered
            if heard.all():
                return state
        silent = ", ".join(self._joints[i] for i in np.flatnonzero(~heard))
        raise BusError(f"no answer from {silent} to ten readings")

    def _all(self, register: str) -> dict[str, int]:
        """One register of all servos; those missed by the sync read are asked singly."""
        values = self._bus.sync_read(register)
        return {name: values[name] if name in values else self._bus.read(name, register) for name in self._joints}
