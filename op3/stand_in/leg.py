"""One leg on the stand: all runs of a suite recorded at once, in logs like those of the whole robot.

With the trunk fixed the branches of the robot do not feel each other, so the leg alone moves exactly as it would on
the robot. The rigid bodies are MuJoCo's at 0.25 ms with Euler's semi-implicit step; servos, sensors and bus are the
stand-in's own.
"""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import datetime
from collections import deque
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from op3.robot import LEG_JOINTS, Excitation, build_scene
from op3.robot.kinematics import rotation_matrix
from op3.robot.units import ACCELERATION_UNIT, ANGLE_UNIT, CURRENT_UNIT, GRAVITY, GYRO_UNIT
from op3.rollout import Metadata, Rollout
from op3.stand_in.hidden import Hidden
from op3.stand_in.leg_sensors import LegSensors
from op3.stand_in.leg_servos import LegServos, LegTruth
from op3.stand_in.play import CONTROL_PERIOD, NOMINAL_BATTERY
from op3.stand_in.robot import CURRENT_LIMIT
from op3.stand_in.sensors import quantise
from op3.stand_in.servos import SLOW_PERIOD

TIMESTEP = 0.00025
"""Step of the physics [s]."""

SETTLE = 0.8
"""How long the first target is held before a recording starts [s]."""

PAUSE = 6.0
"""Time between runs [s]."""

WARM_UP = 240.0
"""How long the leg works before its warm runs [s]."""

MORNING = datetime.datetime(2026, 1, 15, 9, 0)
"""When the first run begins."""

Array = NDArray[np.float64]


def record_leg(truth: LegTruth, suite: Sequence[Excitation], seed: int, robot_id: str = "leg") -> list[Rollout]:
    """Record every run of a suite on one leg.

    Args:
        truth: of the leg.
        suite: runs of equal length, in the order in which they are recorded.
        seed: of noise and jitter. Equal seeds give equal bytes.
        robot_id: identity of the leg in the logs' metadata.

    Returns:
        One rollout of the truth's joints per run, at 125 Hz.
    """
    return _Session(truth, suite, seed).record(robot_id)


class _Session:
    """All runs side by side, [run, joint]."""

    def __init__(self, truth: LegTruth, suite: Sequence[Excitation], seed: int):
        if len({len(run.motion.time) for run in suite}) != 1:
            raise ValueError("the runs of a suite are recorded side by side and must be of equal length")
        if any(run.motion.joints != truth.joints for run in suite):
            raise ValueError(f"the runs must move {', '.join(truth.joints)}")
        self.truth, self.suite = truth, suite
        streams = np.random.SeedSequence([seed, 30]).spawn(5)
        self._slow_rng, self._sensor_rng, self._timing_rng, self._day_rng, self._loss_rng = map(
            np.random.default_rng, streams
        )
        self.targets = np.stack([run.motion.position for run in suite], 1)  # [tick, run, joint]
        self.p_gain = np.array([[run.p_gain] for run in suite])
        self.d_gain = np.array([[run.d_gain] for run in suite])
        self.day_time, temperature = self._day()
        self.servos = LegServos(truth, temperature, self.day_time, TIMESTEP)
        self.batch = Batch(self._model(), len(suite), nthread=1)
        gravity = np.array([0.0, 0.0, -GRAVITY])
        self.batch.expand("opt.gravity")[...] = [rotation_matrix(*run.tilt).T @ gravity for run in suite]
        self.sensors = LegSensors(truth, len(suite))
        self._arrivals: deque[tuple[Array, Array]] = deque()

    def _day(self) -> tuple[Array, Array]:
        """When each run begins [run] in s, and how warm its servos are then [run] in C."""
        warm = np.array([run.warm for run in self.suite])
        length = self.suite[0].motion.time[-1] + SETTLE + PAUSE
        start = np.arange(len(warm)) * length + WARM_UP * np.maximum.accumulate(warm)
        ambient = self.truth.world.ambient_temperature
        cold = ambient + 5 * (1 - np.exp(-start / 120))
        hot = ambient + self._day_rng.uniform(30, 34, len(warm))
        return start, np.where(warm, hot, cold)

    def _model(self) -> mujoco.MjModel:
        """The right leg alone, or the whole robot, with what is hidden in its links."""
        scene = build_scene("stand")
        root: Any = scene.mjcf_model
        if self.truth.joints == LEG_JOINTS:
            for name in ("head_pan_link", "l_sho_pitch_link", "r_sho_pitch_link", "l_hip_yaw_link"):
                root.find("body", f"op3/{name}").remove()
        model = scene.compile(visual=False)
        names = tuple(model.joint(i).name.removeprefix("op3/") for i in range(model.njnt))
        if names != self.truth.joints:
            raise ValueError(f"the joints are {', '.join(names)} where {', '.join(self.truth.joints)} belong")
        model.opt.timestep = TIMESTEP
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_SENSOR)
        model.dof_armature[:] = self.servos.armature
        for hidden in self.truth.hidden:
            _change_body(model, hidden)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def record(self, robot_id: str) -> list[Rollout]:
        """Let all runs pass."""
        batch, runs = self.batch, len(self.suite)
        position, velocity = batch.bind("qpos"), batch.bind("qvel")
        applied, acceleration = batch.bind("qfrc_applied"), batch.bind("qacc")
        placed = self.targets[0] + self.truth.world.placement * self._slow_rng.standard_normal(self.targets[0].shape)
        batch.reset()
        position[...] = self.sensors.true_position(placed)
        self.servos.reset(position, self._slow_rng)
        self.sensors.reset()
        goal = np.zeros((runs, len(self.truth.joints)))
        settling = round(SETTLE / CONTROL_PERIOD)
        ticks = self._tick_steps(settling + len(self.targets) + 1)
        latency, lost = self._transmission(len(ticks))
        sent = goal
        rows = []
        slow = round(SLOW_PERIOD / TIMESTEP)
        for tick in range(len(ticks) - 1):
            target = self.targets[max(tick - settling, 0)]
            reading = self.sensors.read(self.servos, position, self._sensor_rng)
            wanted = self.p_gain * (target - reading["position"]) - self.d_gain * reading["velocity"]
            wanted = np.round(wanted / CURRENT_UNIT) * CURRENT_UNIT
            sent = np.where(lost[tick], sent, wanted.clip(-CURRENT_LIMIT, CURRENT_LIMIT))
            self._arrivals.append((ticks[tick] + latency[tick], sent))
            if tick >= settling:
                rows.append(reading)
            for step in range(ticks[tick], ticks[tick + 1]):
                goal, now = self._receive(step, goal)
                applied[...] = self.servos.step(now, position, velocity, acceleration)
                batch.step()
                if (step + 1) % slow == 0:
                    self.servos.step_slow((step + 1) * TIMESTEP, self._slow_rng)
                    self.sensors.step(position, velocity)
            if not np.isfinite(position).all():
                raise RuntimeError(f"the leg's physics diverged at {ticks[tick] * TIMESTEP:.3f} s")
        time = (ticks[settling:-1] - ticks[settling]) * TIMESTEP
        return [self._rollout(i, time, rows, robot_id) for i in range(runs)]

    def _tick_steps(self, count: int) -> NDArray[np.int64]:
        """Steps at which the computer reads the sensors [tick]: every 8 ms, give or take a step."""
        jitter = np.round(0.7 * self._timing_rng.standard_normal(count)).clip(-1, 1).astype(int)
        jitter[0] = 0
        return np.arange(count) * round(CONTROL_PERIOD / TIMESTEP) + jitter

    def _transmission(self, count: int) -> tuple[Array, NDArray[np.bool_]]:
        """How long each command is under way [tick, run, 1] in steps, and whether it gets lost [tick, run, 1]."""
        world, shape = self.truth.world, (count, len(self.suite), 1)
        jitter = world.latency_jitter * self._timing_rng.standard_normal(shape).clip(-3, 3)
        delay = np.maximum(world.command_latency + jitter, 0.0) / TIMESTEP
        draw = self._loss_rng.random(shape)
        hidden = self.truth.find("packet_drop")
        if hidden is None:
            return delay, np.zeros(shape, dtype=bool)
        if hidden.form == "single":
            return delay, draw < hidden.size
        begins = draw < hidden.size / 3
        return delay, begins | np.roll(begins, 1, 0) | np.roll(begins, 2, 0)

    def _receive(self, step: int, goal: Array) -> tuple[Array, Array]:
        """The goal currents held after this step, and their mean over it."""
        now = goal
        while self._arrivals:
            arrival, current = self._arrivals[0]
            share = (step + 1 - arrival).clip(0, 1)
            if not share.any():
                break
            now = now + share * (current - now)
            if not share.all():
                # those that arrived stay; the rest is looked at again in the next step
                break
            goal = current
            self._arrivals.popleft()
        return goal, now

    def _rollout(self, run: int, time: Array, rows: list[dict[str, Array]], robot_id: str) -> Rollout:
        excitation, ones = self.suite[run], np.ones((len(time), len(self.truth.joints)))
        arrays: dict[Any, Array] = {("joint", name): np.stack([row[name][run] for row in rows]) for name in rows[0]}
        arrays["command", "position"] = self.targets[:, run]
        arrays["command", "p_gain"] = excitation.p_gain * ones
        arrays["command", "d_gain"] = excitation.d_gain * ones
        arrays.update(self._imu(excitation, len(time)))
        begin = MORNING + datetime.timedelta(seconds=float(self.day_time[run]))
        metadata = Metadata(
            joints=self.truth.joints,
            robot="simulated",
            mount="stand",
            rate=1 / CONTROL_PERIOD,
            battery=NOMINAL_BATTERY,
            servo="xm430-w350",
            motion=excitation.motion.name,
            recording=f"{robot_id}/{run:02d}",
            date=begin.isoformat(timespec="seconds"),
            extra={"robot_id": robot_id, "tilt": [float(angle) for angle in excitation.tilt]},
        )
        return Rollout.from_arrays({"time": time, **arrays}, metadata)

    def _imu(self, excitation: Excitation, rows: int) -> dict[Any, Array]:
        """What the IMU of a trunk that does not move reads."""
        world = self.truth.world
        rng = self._sensor_rng
        rates = world.gyro_noise * 0.3 * rng.standard_normal((rows, 3))
        force = rotation_matrix(*excitation.tilt).T @ np.array([0.0, 0.0, GRAVITY])
        force = force + 0.3 * world.accelerometer_noise * rng.standard_normal((rows, 3))
        return {
            ("imu", "orientation"): np.tile(quantise(np.array([*excitation.tilt, 0.0]), ANGLE_UNIT), (rows, 1)),
            ("imu", "angular_velocity"): quantise(rates, GYRO_UNIT),
            ("imu", "linear_acceleration"): quantise(force, ACCELERATION_UNIT),
        }


def _change_body(model: mujoco.MjModel, hidden: Hidden) -> None:
    """What an effect changes in the links beyond its joints."""
    for joint in hidden.joints:
        body = model.body(f"op3/{joint}_link").id
        if hidden.name == "link_mass":
            mass, size = model.body_mass[body], hidden.size
            if hidden.form == "plate":  # under the sole, 60 mm by 40 mm
                below = np.array([0.02, 0.0, -0.035])
                share = size / (mass + size)
                apart = below - model.body_ipos[body]
                model.body_ipos[body] += share * apart
                model.body_inertia[body] += size * (0.06**2 + 0.04**2) / 12 + (1 - share) * size * (apart @ apart) * 0.7
            model.body_mass[body] = mass + size
        elif hidden.name == "link_com":
            model.body_ipos[body, 0] += hidden.size
        elif hidden.name == "link_inertia":
            model.body_inertia[body] += hidden.size * model.body_mass[body]
