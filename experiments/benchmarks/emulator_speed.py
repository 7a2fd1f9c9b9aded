"""Measure how much faster than real time the emulated robot runs, driven through dynamixel-sdk on one core.

python experiments/benchmarks/emulator_speed.py [seconds]

A tick of 8 ms reads ten bytes of all servos and the IMU, computes a PD and writes all goal currents. The robot stands
on the floor. Processor time, which depends less on the load of the machine, is printed too, with the share of the
physics alone: MuJoCo's steps and the servo law.
"""

import argparse
import statistics
import time

import numpy as np
import torch
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler

from op3.deploy.emulator import EmulatedRobot, Physics, SimPhysics, StandInPhysics, VirtualPort
from op3.deploy.registers import OPEN_CR_ID, POSITION_ZERO
from op3.report import machine
from op3.robot import load_robot
from op3.robot.register_units import CURRENT_UNIT, POSITION_UNIT, VELOCITY_UNIT
from op3.scenes import build_scene
from op3.sim import load_model
from op3.stand_in import HiddenWorld

TICK = 0.008
ROUNDS = 5


class Computer:
    """A minimal controller: power on, current mode, PD at the home pose."""

    def __init__(self, robot: EmulatedRobot):
        self.robot = robot
        self.port, self.packets = VirtualPort(robot), PacketHandler(2.0)
        self.port.setBaudRate(2_000_000)
        self.packets.write1ByteTxRx(self.port, OPEN_CR_ID, 24, 1)
        robot.clock.sleep(0.2)
        self.ids = list(load_robot("op3").bus_ids.values())
        self.reader = GroupSyncRead(self.port, self.packets, 126, 10)
        self.writer = GroupSyncWrite(self.port, self.packets, 102, 2)
        for number in self.ids:
            for address, size, value in ((11, 1, 0), (102, 2, 0), (64, 1, 1)):
                self.packets.writeTxRx(self.port, number, address, size, list(value.to_bytes(size, "little")))
            self.reader.addParam(number)
            self.writer.addParam(number, [0, 0])
        self.target = load_robot("op3").home
        self.start, self.ticks = robot.clock.now(), 0

    def tick(self) -> None:
        """Read, compute, write, wait."""
        self.reader.txRxPacket()
        self.packets.readTxRx(self.port, OPEN_CR_ID, 32, 18)
        data = np.frombuffer(b"".join(bytes(self.reader.data_dict[number]) for number in self.ids), "<i2, <i4, <i4")
        position = (data["f2"] - POSITION_ZERO) * POSITION_UNIT
        current = 6.0 * (self.target - position) - 0.1 * data["f1"] * VELOCITY_UNIT
        counts = np.clip(np.round(current / CURRENT_UNIT), -855, 855).astype("<i2")
        for number, goal in zip(self.ids, counts, strict=True):
            self.writer.changeParam(number, list(goal.tobytes()))
        self.writer.txPacket()
        self.ticks += 1
        self.robot.clock.sleep_until(self.start + self.ticks * TICK)


def measure(computer: Computer, seconds: float) -> tuple[float, float, float]:
    """Emulated time relative to wall time and to processor time, and the share of the physics in the latter."""
    wall, processor = time.perf_counter(), time.process_time()
    for _ in range(round(seconds / TICK)):
        computer.tick()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    bare = time.process_time()
    computer.robot.physics.advance(seconds)
    bare = time.process_time() - bare
    return seconds / wall, seconds / processor, bare / processor


def main() -> None:
    """Measure both kinds of physics alternately, and print medians."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "seconds", type=float, nargs="?", default=2.0, help="duration of a round on the robot's clock [s]"
    )
    seconds = parser.parse_args().seconds
    made: dict[str, Physics] = {
        "op3/sim": SimPhysics(load_model("paper"), build_scene("floor", "op3")),
        "op3/stand_in": StandInPhysics(HiddenWorld(), build_scene("floor", "op3")),
    }
    computers = {name: Computer(EmulatedRobot(physics)) for name, physics in made.items()}
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in made}
    for _ in range(ROUNDS):
        for name, computer in computers.items():
            rows[name].append(measure(computer, seconds))
    print("machine: " + ", ".join(f"{key} {value}" for key, value in machine().items()))
    for name, measured in rows.items():
        by_wall, by_processor, share = (statistics.median(column) for column in zip(*measured, strict=True))
        best = max(row[0] for row in measured)
        print(
            f"{name:13s} {by_wall:5.1f} x real time (best round {best:.1f}), {by_processor:.1f} x by processor time,"
            f" {share:.0%} of it physics"
        )


if __name__ == "__main__":
    main()
