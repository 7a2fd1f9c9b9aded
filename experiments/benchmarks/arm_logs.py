"""Identify a real arm from half of its runs, and measure how well the model predicts the other half.

python experiments/benchmarks/arm_logs.py <folder of SAGE pairs of an SO-101> [0 | 1]

Runs are split by name: every second one is fitted, beginning with the first (0) or the second (1); the others are
predicted open loop through MuJoCo. The fit simulates whole logs as windows around the measured motion, which is about
fifty times as fast. It runs twice, the second time around the encoder offsets of the first fit.
"""

import argparse
import time
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from op3.identify.prediction_score import predict_logs
from op3.identify.refine import refine
from op3.identify.sensitivity import Box
from op3.replay import Setup
from op3.replay.log_replay import gain_of
from op3.robot import load_robot
from op3.rollout import Rollout, read_logs
from op3.servo import RobotModel, effect_class
from op3.servo.conditions import split_name
from op3.sim import MeasuredMotion, TrajectoryDynamics, Window, WindowSimulation, servo_model, trajectory_dynamics

PREROLL, STEPS = 4, 10
"""Rows that lead into a window, and steps of the simulation per row of about 20 ms."""

EVERY = 5
"""Spacing of the rows at which the dynamics are computed; they are interpolated between these rows."""

ROBUST = 0.02
"""Difference above which the loss grows linearly [rad], so that a few deviating rest positions do not dominate."""

SHARED: Mapping[str, tuple[float, float]] = {
    "controller_gain": (0.15, 1.5),
    "torque_constant": (0.002, 0.01),
    "terminal_resistance": (1.0, 10.0),
    "viscous_friction": (0.0, 0.3),
    "derivative_gain": (0.0, 0.3),
    "command_latency": (0.0, 0.02),
    "minimum_duty": (0.0, 0.1),
    "static_friction_excess": (0.0, 0.2),
    "backward_efficiency": (0.3, 1.0),
}
"""Ranges of parameters that all servos share: they are of one make, and the user may have set another firmware gain."""

OWN: Mapping[str, tuple[float, float]] = {"encoder_offset": (-0.4, 0.4), "coulomb_friction": (0.0, 0.3)}
"""Ranges of parameters that differ between joints; the zeros in the robot's file are approximate."""

PLAIN = ("viscous_friction", "command_latency", "coulomb_friction")
"""Parameters searched for the simple friction model, whose gain and zeros come from the files."""


def whole_model() -> RobotModel:
    """The model of the servo make, with encoder offsets and the minimum duty of the firmware."""
    model = servo_model(load_robot("arm")).with_effect(effect_class("encoder_offset")(), {"encoder_offset": 0.0})
    model = model.with_effect(effect_class("minimum_duty")(), {"minimum_duty": 0.01, "minimum_duty_fade": 0.02})
    return model.with_values({"controller_gain": 0.6})


class Windows:
    """Whole logs of an arm, simulated as windows around the measured motion.

    Args:
        model: effects and values.
        logs: logs of one robot.
        zeros: known differences of readings from true angles, ``[joint]`` [rad].
    """

    def __init__(self, model: RobotModel, logs: Sequence[Rollout], zeros: np.ndarray):
        self.zeros, self.joints = zeros, logs[0].joints
        self.period = float(np.median(np.concatenate([np.diff(log.array("time")[:, 0]) for log in logs])))
        setup = Setup.of_mount("stand", joints=self.joints, control_period=self.period, robot=logs[0].robot)
        self.motions = [self._motion(log, setup) for log in logs]
        self.simulations = [
            WindowSimulation(
                model, [motion], [Window(0, PREROLL)], len(motion.position) - PREROLL - 2, self.joints,
                timestep=self.period / STEPS, preroll=PREROLL, dtype=torch.float64,
            )
            for motion in self.motions
        ]  # fmt: skip

    def _motion(self, log: Rollout, setup: Setup) -> MeasuredMotion:
        angle = log.array("joint/position") - self.zeros
        speed, faster = (gaussian_filter1d(x, 1.0, axis=0) for x in self._rates(angle))
        rows = np.unique([*range(0, len(angle), EVERY), len(angle) - 1])
        start = setup.scene.initial_qpos(angle[0])
        known = trajectory_dynamics(setup.mj_model, setup.scene.joint_names, angle[rows], speed[rows], start)
        fields = (known.mass, known.bias, known.gradient, known.damping, known.radial_force, known.carried)
        dynamics = TrajectoryDynamics(*(_between(field, rows, len(angle)) for field in fields))
        none = [np.zeros_like(field) for field in (dynamics.mass, dynamics.bias, dynamics.gradient, dynamics.damping)]
        # a joint whose encoder reads more stands at a smaller angle
        turned: dict[tuple[str, int | None], TrajectoryDynamics] = {
            ("encoder_offset", j): TrajectoryDynamics(
                none[0], -dynamics.gradient[:, :, j].copy(), none[2], none[3], none[1], 0 * dynamics.carried
            )
            for j in range(len(self.joints))
        }
        commands = {"position_target": log.array("command/position") - self.zeros}
        commands["firmware_gain"] = np.full_like(angle, gain_of(log))
        unread = np.full_like(angle, np.nan)  # the loop is closed in the servo
        return MeasuredMotion(
            self.period, angle, speed, faster, unread, unread, none[1], log.array("time"), commands, dynamics, turned
        )

    def _rates(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        speed = gaussian_filter1d(np.gradient(angle, self.period, axis=0), 1.0, axis=0)
        return speed, np.gradient(speed, self.period, axis=0)

    def residuals(self, values: Mapping[str, Tensor], candidates: int) -> Tensor:
        """Robust residuals of all logs, ``[candidate, residual]``."""
        moved = dict(values)
        if "encoder_offset" in moved:
            moved["encoder_offset"] = moved["encoder_offset"] - torch.from_numpy(self.zeros)
        parts = []
        for simulation, motion in zip(self.simulations, self.motions, strict=True):
            angle = simulation.run(moved, candidates)["joint", "position"][:, 0]
            left = angle - torch.from_numpy(motion.position[PREROLL : PREROLL + angle.shape[1]])
            left = torch.nan_to_num(left, nan=1.0).clamp(-1.0, 1.0)
            tamed = left * torch.sqrt(2 * ROBUST / (torch.sqrt(left.square() + ROBUST**2) + ROBUST))
            parts.append(tamed.flatten(1) / (tamed[0].numel() * len(self.motions)) ** 0.5)
        return torch.cat(parts, 1)


def _between(field: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """Values at all rows, linear between those that are known."""
    columns = [np.interp(np.arange(count), rows, column) for column in field.reshape(len(rows), -1).T]
    return np.stack(columns, 1).reshape(count, *field.shape[1:])


def fit(model: RobotModel, logs: Sequence[Rollout], searched: Sequence[str]) -> RobotModel:
    """The model with parameters fitted to the logs by least squares, starting from its values."""
    joints = logs[0].joints
    bounds = {name: SHARED[name] for name in searched if name in SHARED}
    bounds |= {f"{name}@joint={joint}": OWN[name] for name in searched if name in OWN for joint in joints}
    low, span = (
        torch.tensor(x, dtype=torch.float64) for x in zip(*((a, b - a) for a, b in bounds.values()), strict=True)
    )
    for _ in range(2):
        zeros = model.tensors(joints)["encoder_offset"][0].numpy()
        windows = Windows(model, logs, zeros)

        def residuals(unit: Tensor, windows: Windows = windows) -> Tensor:
            columns: dict[str, list[Tensor]] = {}
            for name, value in zip(bounds, (low + unit * span).unbind(1), strict=True):
                columns.setdefault(split_name(name)[0], []).append(value)
            values = {name: torch.stack(v, 1) if len(v) > 1 else v[0] for name, v in columns.items()}
            return windows.residuals(values, len(unit))

        start = {name: model.estimate(name).value for name in bounds}
        found = refine(residuals, Box.of(bounds), [start], max_iterations=12)
        model = model.with_values(found.values)
        print(f"  error of the fitted runs {1e3 * found.loss**0.5:.1f} mrad (robust)", flush=True)
    return model


def main() -> None:
    """Fit the models, predict the held-out runs, and print the errors."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("logs", help="folder with SAGE pairs of an SO-101")
    parser.add_argument("first", type=int, nargs="?", default=0, choices=(0, 1), help="index of the first fitted run")
    given = parser.parse_args()
    logs = read_logs(given.logs, "arm")
    fitted, withheld = logs[given.first :: 2], logs[1 - given.first :: 2]
    print("fitted: " + ", ".join(log.metadata.recording or "" for log in fitted))
    whole = whole_model()
    plain = whole.without("dte", "stribeck", "minimum_duty").with_values({"derivative_gain": 0.0})
    for label, model, searched in (
        ("Coulomb and viscous friction", plain.with_values({"controller_gain": 1.0}), PLAIN),
        ("the same, with controller gain and encoder offsets", plain, (*PLAIN, "controller_gain", "encoder_offset")),
        ("full model", whole, (*SHARED, *OWN)),
    ):
        started = time.process_time()
        print(label, flush=True)
        found = fit(model, fitted, searched)
        print(f"  {time.process_time() - started:.0f} s of processor time; " + _spoken(found, searched))
        score = predict_logs(found, withheld)
        errors = [
            np.abs(p.channels["joint", "position"][0].numpy() - p.log.array("joint/position")).mean(0)
            for p in score.predictions
        ]
        for log, error in zip(withheld, errors, strict=True):
            print(f"  {log.metadata.recording:20s}" + "".join(f"{1e3 * one:7.1f}" for one in error))
        mean = 1e3 * np.mean(errors, 0)
        print("  held-out runs, mrad   " + ", ".join(f"{j} {e:.1f}" for j, e in zip(logs[0].joints, mean, strict=True)))
        print(f"  mean {mean.mean():.1f} mrad", flush=True)


def _spoken(model: RobotModel, names: Sequence[str]) -> str:
    """Fitted values as text; values of single joints are listed one after the other."""
    rows = {name: model.tensors(load_robot("arm").joints)[name][0].tolist() for name in names}
    return "; ".join(f"{n} {', '.join(f'{v:.3g}' for v in (r if n in OWN else r[:1]))}" for n, r in rows.items())


if __name__ == "__main__":
    main()
