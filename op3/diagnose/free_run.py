"""Residuals of free runs: whole logs in closed loop, for logs that windows cannot take, such as those of the bench.

What is compared is the same as for windows, on a uniform grid; a second of a log is one window, two seconds are one
block.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from op3.diagnose.split import LogSplit
from op3.diagnose.windows import WindowResiduals
from op3.rollout import LogError, Rollout
from op3.servo import RobotModel
from op3.tasks import Replay

FLOOR = {("joint", "position"): 0.005, ("joint", "velocity"): 0.1, ("joint", "current"): 0.02, ("joint", "duty"): 0.03}
"""Differences that do not matter in a free run, by channel [rad, rad/s, A, -]."""

IMU = {
    ("imu", "orientation"): (0.005, 2),
    ("imu", "angular_velocity"): (0.02, 3),
}
"""The same of a robot on its feet [rad, rad/s], and how many values of each count: of the orientation not the yaw."""

ROBUST = 3.0
"""Differences beyond this many usual ones count less (pseudo-Huber): in some runs something else happened."""

GRID = 0.02
"""Time between compared samples [s]."""

SECOND = 50
"""Samples of a window."""

BLOCK = 2
"""Seconds that are taken as dependent: a servo in closed loop, or a pendulum with friction, forgets within them."""

COARSER = 2
"""How many times longer the steps of a coarse simulation on the bench are."""


FEW = 4
"""Logs of a robot on its feet that are simulated, at most, of those that fit and of those that choose."""

BEGINNING = 5.0
"""How much of each [s]: a free run that has gone astray says nothing of what comes later."""

SETTLE = 0.2
"""Time for which the first command is held before a replay begins [s]."""


def settle_time(logs: Sequence[Rollout]) -> float:
    """How long the first command of logs is held before their replay [s]: not at all where nothing holds the joints."""
    held = [bool((log.array("command/torque_enable")[0] > 0.5).all()) for log in logs if "command/torque_enable" in log]
    return SETTLE if all(held) else 0.0


def _shortened(logs: Sequence[Rollout]) -> list[Rollout]:
    """Logs of a bench as they are; of a robot, whose contacts cost a hundred times as much, the beginnings of a few."""
    if logs[0].metadata.mount == "pendulum":
        return list(logs)
    every = max(1, -(-len(logs) // FEW))
    return [
        log.between(float(log.array("time")[0, 0]), float(log.array("time")[0, 0]) + BEGINNING) for log in logs[::every]
    ]


class FreeRunResiduals:
    """Free runs of the logs of a split, and the residuals of any model on them.

    The servo's duty is compared where it was logged: a false controller gain, or a delay, would show in it. So is what
    the IMU of a robot on its feet says.

    Args:
        split: the logs; all of one mount, with the same joints.
        timestep: simulation step on the bench [s].

    Raises:
        LogError: if logs differ in joints or mount.
    """

    def __init__(self, split: LogSplit, *, timestep: float = 0.002):
        self.split = split
        fit, select = (_shortened(split.fit), _shortened(split.select))
        logs = [*fit, *select]
        first = logs[0]
        for log in split.logs:
            if log.joints != first.joints or log.metadata.mount != first.metadata.mount:
                raise LogError(
                    "the logs differ in joints or mount",
                    "diagnose logs of one set-up at a time",
                    source=log.metadata.recording,
                    column="joints",
                )
        self.joints: tuple[str, ...] = first.joints
        self.channels = tuple(key for key in FLOOR if all(key in log for log in logs))
        if first.metadata.mount == "pendulum":
            # bench logs carry a velocity that the recorders computed from positions
            self.channels = tuple(key for key in self.channels if key != ("joint", "velocity"))
        held = first.metadata.mount in ("stand", "pendulum")
        self.imu = () if held else tuple(key for key in IMU if all(key in log for log in logs))
        settle, coarse = settle_time(logs), COARSER * timestep
        self._fit = Replay(fit, settle=settle, bench_timestep=timestep)
        self._all = Replay(logs, settle=settle, bench_timestep=timestep)
        self._coarse, self._coarse_fit = self._all, self._fit
        if first.metadata.mount == "pendulum":
            self._coarse = Replay(logs, settle=settle, bench_timestep=coarse)
            self._coarse_fit = Replay(fit, settle=settle, bench_timestep=coarse)
        self._seconds = [max(1, int(log.duration / (GRID * SECOND))) for log in logs]
        self.is_fit = np.repeat([i < len(fit) for i in range(len(logs))], self._seconds)
        begins = np.cumsum([0, *(-(-seconds // BLOCK) for seconds in self._seconds)])
        self.blocks = np.concatenate(
            [first + np.arange(seconds) // BLOCK for first, seconds in zip(begins, self._seconds, strict=False)]
        )
        self._floor = np.array([FLOOR[key] for key in self.channels])
        self._imu_floor = np.array([floor for floor, count in (IMU[key] for key in self.imu) for _ in range(count)])
        self.scale, self.imu_scale = self._floor, self._imu_floor

    def prepare(self, model: RobotModel) -> None:
        """Take the usual size of the residuals from this model."""
        joints, trunk = self._errors(self._all, model, {}, 1)
        usual = 1.4826 * np.median(np.abs(joints), axis=(0, 1, 2, 3))
        self.scale = np.sqrt(self._floor**2 + usual**2)
        if self.imu:
            usual = 1.4826 * np.median(np.abs(trunk), axis=(0, 1, 2))
            self.imu_scale = np.sqrt(self._imu_floor**2 + usual**2)

    def squares_by_joint(self, residual: np.ndarray) -> np.ndarray:
        """Sums of squares of residuals ``[window, residual]``, ``[window, joint]``."""
        shape = (len(residual), SECOND, len(self.joints), len(self.channels))
        of_joints = residual[:, : int(np.prod(shape[1:]))]
        return np.square(of_joints.reshape(shape).astype(np.float64)).sum((1, 3))

    def residuals(
        self,
        model: RobotModel,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        fit_only: bool = False,
        stretch: int = 1,
    ) -> np.ndarray:
        """Whitened residuals, ``[candidate, window, residual]``; steps are stretched by `COARSER`, on benches only."""
        choices = (self._coarse, self._coarse_fit) if stretch > 1 and not model.stiff else (self._all, self._fit)
        replay = choices[1] if fit_only else choices[0]
        parts, size = [], 32
        for begin in range(0, candidates, size):
            count = min(size, candidates - begin)
            values = {name: value[begin : begin + count] for name, value in (parameters or {}).items()}
            joints, trunk = self._errors(replay, model, values, count)
            both = [_tamed(joints / self.scale), _tamed(trunk / self.imu_scale)]
            parts.append(np.concatenate([one.reshape(*one.shape[:2], -1) for one in both], -1).astype(np.float32))
        return np.concatenate(parts)

    def _errors(
        self, replay: Replay, model: RobotModel, values: Mapping[str, Tensor], count: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulated minus measured: ``[candidate, window, sample, joint, channel]``, and of the IMU its values last."""
        predictions = replay.run(model, values, count)
        parts, imu = [], []
        for prediction, seconds in zip(predictions, self._seconds, strict=False):
            channels = prediction.channels
            errors = [self._on_grid(channels[key].numpy(), prediction.log, key, seconds) for key in self.channels]
            parts.append(np.stack(errors, -1))
            told = [self._on_grid(channels[key].numpy(), prediction.log, key, seconds) for key in self.imu]
            told = [values[..., : IMU[key][1]] for values, key in zip(told, self.imu, strict=True)]
            imu.append(np.concatenate([*told, np.zeros((*errors[0].shape[:3], 0))], -1))
        return (
            np.nan_to_num(np.concatenate(parts, 1), nan=1e3, posinf=1e3, neginf=-1e3),
            np.nan_to_num(np.concatenate(imu, 1), nan=1e3, posinf=1e3, neginf=-1e3),
        )

    def _on_grid(self, simulated: np.ndarray, log: Rollout, key: tuple[str, str], seconds: int) -> np.ndarray:
        """Differences on the grid, ``[candidate, second, sample, joint]``."""
        time = log.array("time")[:, 0] - log.array("time")[0, 0]
        error = simulated - log.array(key)[: simulated.shape[1]]
        nearest = np.clip(np.searchsorted(time, np.arange(seconds * SECOND) * GRID), 0, error.shape[1] - 1)
        picked = error[:, nearest]
        return picked.reshape(len(picked), seconds, SECOND, -1)


def _tamed(error: np.ndarray) -> np.ndarray:
    """Whitened errors, of which large ones count less."""
    return np.sign(error) * np.sqrt(2 * ROBUST * (np.sqrt(error**2 + ROBUST**2) - ROBUST))


def engine_for(split: LogSplit, fit_windows: int = 60, select_windows: int = 36) -> WindowResiduals | FreeRunResiduals:
    """The engine that suits the logs: windows on the stand, free runs otherwise."""
    if split.fit[0].metadata.mount == "stand":
        return WindowResiduals(split, fit_windows=fit_windows, select_windows=select_windows)
    return FreeRunResiduals(split)
