"""Open-loop replay: simulates the commands of logs for many parameter sets at once."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from op3.common.settings import CONTROL_PERIOD
from op3.replay.log_parameters import parameters_per_log
from op3.replay.setups import BENCH_CONTROL_PERIOD, Setup
from op3.rollout import LogError, Rollout, stand_tilt
from op3.rollout.schema import COMMAND_CHANNELS
from op3.servo import RobotModel

BENCH_SAMPLING = 0.005
"""Interval between simulated states of a pendulum that are stored [s]; others are interpolated."""

SAME_RATE = 0.02
"""Relative difference up to which a measured rate counts as the usual rate."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Simulated channels of a log.

    Attributes:
        log: the log that was replayed.
        channels: values by channel, ``[candidate, time, joint | 3]`` at the log's times.
        failed: candidates whose simulation diverged, ``[candidate]``.
        simulated_seconds: simulated time spent on this log, over all candidates [s].
    """

    log: Rollout
    channels: Mapping[tuple[str, str], Tensor]
    failed: Tensor
    simulated_seconds: float


class Replay:
    """Replays a fixed set of logs for any model and any parameters.

    The simulation starts from the log's first row at rest, holds the first command for ``settle`` seconds, and then
    receives each command at the control tick at which it applied. Of the measurements after the first row, the
    simulation receives only the bus voltage, if the log has it. A log from the stand may have only some complete limbs;
    the other limbs are omitted. A robot's PD ticks at the rate of the log's rows, or at the ``control_rate`` [Hz] of
    its metadata's ``extra``. Servos that close the loop themselves use the gain of the log or its metadata, otherwise
    that of their make.

    Args:
        logs: logs to replay; mounts may differ.
        settle: time before the first row in which the first command is held [s].
        duration: longest replay [s].
        bench_timestep: simulation step of bench logs [s].
        num_threads: threads that step the physics of a robot; 0 for all processors.
    """

    def __init__(
        self,
        logs: Sequence[Rollout],
        *,
        settle: float = 0.2,
        duration: float | None = None,
        bench_timestep: float = BENCH_CONTROL_PERIOD,
        num_threads: int = 0,
    ):
        if not logs:
            raise ValueError("there is nothing to replay: give at least one log")
        self.logs = list(logs)
        self._groups: list[_Group] = []
        mounts = [(*_mount(log), log.joints, _control_period(log), log.robot.reference) for log in logs]
        for mount, members in groupby(sorted(range(len(logs)), key=mounts.__getitem__), key=mounts.__getitem__):
            setup = Setup.of_mount(mount[0], bench_timestep, mount[1:3], *mount[3:-1], robot=mount[-1])
            self._groups.append(_Group(list(members), logs, setup, settle, duration, num_threads))

    @property
    def seconds(self) -> float:
        """Simulated time per parameter set [s]."""
        return sum(group.seconds for group in self._groups)

    def run(
        self,
        model: RobotModel,
        parameters: Mapping[str, Tensor] | None = None,
        candidates: int = 1,
        progress: Callable[[float], None] | None = None,
        push: Sequence[np.ndarray] | None = None,
    ) -> list[Prediction]:
        """Simulate every log for every candidate.

        Args:
            model: effects, and values of all other parameters.
            parameters: values by name, possibly with a condition: ``[candidate]`` or ``[candidate, joint]``.
            progress: function called with the completed share, 0 to 1.
            push: torque on the joints in addition to the servos' [N m], of each log ``[row, joint]``; of a robot only.

        Returns:
            One prediction per log, in the order of the logs.

        Raises:
            ValueError: if `push` is given for a bench.
        """
        if push is not None and any(group.setup.pendulum for group in self._groups):
            raise ValueError("push: a bench has no torque other than its servo's")
        predictions: dict[int, Prediction] = {}
        for group in self._groups:
            predictions.update(group.run(model, parameters or {}, candidates, progress, push))
        return [predictions[i] for i in range(len(self.logs))]


class _Group:
    """Logs of one mount, padded to one length."""

    def __init__(self, members, logs, setup, settle, duration, num_threads):
        self.members, self.num_threads = members, num_threads
        self.logs = [logs[i] for i in members]
        self.setup = setup
        self.period = self.setup.control_period
        self.every = max(1, round(BENCH_SAMPLING / self.period)) if self.setup.pendulum else 1
        self.settle = round(settle / self.period)
        times = [log.array("time")[:, 0] - log.array("time")[0, 0] for log in self.logs]
        if duration is not None:
            times = [time[time <= duration + 1e-9] for time in times]
        self.times = times
        longest = max(time[-1] for time in times)
        self.ticks = self.every * int(np.ceil(longest / (self.every * self.period) - 1e-6))
        self.commands = self._commands()
        self.qpos = np.stack([self.setup.initial_qpos(log) for log in self.logs])

    @property
    def seconds(self) -> float:
        return (self.ticks + self.settle) * self.period * len(self.logs)

    def _commands(self) -> dict[str, Tensor]:
        """Commands at every tick, ``[tick, log, joint]``; constant commands have the shape ``[1, log, joint]``.

        A command that a log does not have is NaN here: the model's value replaces it, or the replay is refused.
        """
        at = np.arange(self.ticks) * self.period
        commands = {}
        for channel, name in COMMAND_CHANNELS.items():
            held = []
            for log, time in zip(self.logs, self.times, strict=True):
                if channel in log:
                    # a command applies from the tick nearest to its time stamp, so that clock jitter does not cost a
                    # tick
                    near = at + 0.5 * min(self.period, float(np.median(np.diff(time))))
                    row = np.clip(np.searchsorted(time, near, side="right") - 1, 0, len(time) - 1)
                    held.append(log.array(channel)[row])
                else:
                    held.append(np.full((self.ticks, len(log.joints)), _fallback(name, log)))
            tensor = torch.from_numpy(np.stack(held, axis=1))
            constant = ((tensor == tensor[:1]) | tensor.isnan()).all()
            commands[name] = tensor[:1] if constant else tensor
        return commands

    def _complete(self, model: RobotModel) -> dict[str, Tensor]:
        """The commands, with the model's values for missing ones.

        Raises:
            LogError: if a log lacks a command that the model's servos need.
        """
        needed = {name for effect in model.effects for name in effect.commands}
        unread = {"temperature"} - {name for effect in model.effects for name in effect.reads}
        complete = {}
        for name, values in self.commands.items():
            if name in unread:
                continue
            absent = values[0].isnan().any(-1)
            if name in needed and absent.any():
                log = self.logs[int(absent.nonzero()[0, 0])]
                channel = next("/".join(key) for key, command in COMMAND_CHANNELS.items() if command == name)
                raise LogError(
                    f"the log has no {channel}, which the model's servos need",
                    f"record it, write `{name}:` into the log's YAML, or choose a model of the recorded servo",
                    source=log.metadata.recording,
                    column=channel,
                )
            if name == "bus_voltage":
                shares = [log.robot.supply_shares[log.robot.indices(log.joints)] for log in self.logs]
                values = torch.where(values.isnan(), model.bus_voltage * torch.from_numpy(np.stack(shares)), values)
            if not values.isnan().any():
                complete[name] = values
        return complete

    def _held(self, commands: Mapping[str, Tensor], tick: int, candidates: int, constants: bool) -> dict[str, Tensor]:
        result = {}
        for name, values in commands.items():
            if constants or len(values) > 1:
                row = values[min(tick, len(values) - 1)]
                result[name] = row if len(row) == 1 else row.repeat(candidates, 1)
        return result

    def _held_push(self, push: Sequence[np.ndarray]) -> np.ndarray:
        """Applied torque at every tick, ``[tick, log, joint]``."""
        at = np.arange(self.ticks) * self.period + 0.5 * self.period
        rows = [np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(time) - 1) for time in self.times]
        return np.stack([push[i][row] for i, row in zip(self.members, rows, strict=True)], axis=1)

    def run(self, model, parameters, candidates, progress, push) -> dict[int, Prediction]:
        simulation = self.setup.simulation(model, self.logs, candidates, self.num_threads)
        pushed = None if push is None else self._held_push(push)
        simulation.set_parameters(parameters_per_log(model, parameters, self.logs, candidates))
        qpos = np.tile(self.qpos, (candidates, 1))
        commands = self._complete(model)
        simulation.reset(qpos, self._held(commands, 0, candidates, constants=True), measured=True)
        for _ in range(self.settle):
            simulation.advance()
        samples: list[dict] = []
        for tick in range(self.ticks):
            if tick % self.every == 0:
                samples.append(simulation.measure())
                if progress is not None and len(samples) % 25 == 0:
                    progress(tick / self.ticks)
            simulation.command(**self._held(commands, tick, candidates, constants=False))
            if pushed is not None:
                simulation.push(np.tile(pushed[tick], (candidates, 1)))
            simulation.advance()
        samples.append(simulation.measure())
        return self._predictions(simulation, samples, candidates)

    def _predictions(self, simulation, samples, candidates) -> dict[int, Prediction]:
        recorded = np.arange(len(samples)) * self.every * self.period
        failed = simulation.failed.view(candidates, len(self.logs))
        samples_of = cache(lambda key: torch.stack([sample[key] for sample in samples], 1))
        predictions = {}
        for i, (log, time) in enumerate(zip(self.logs, self.times, strict=True)):
            channels = _Channels(samples[0], samples_of, slice(i, None, len(self.logs)), recorded, time)
            seconds = (self.ticks + self.settle) * self.period * candidates
            predictions[self.members[i]] = Prediction(log, channels, failed[:, i], seconds)
        return predictions


class _Channels(Mapping[tuple[str, str], Tensor]):
    """Channels at a log's times, interpolated when first used, because most callers need few of them."""

    def __init__(self, keys, samples_of, rows: slice, recorded: np.ndarray, time: np.ndarray):
        self._keys, self._samples_of, self._rows = tuple(keys), samples_of, rows
        self._recorded, self._time = recorded, time
        self._known: dict[tuple[str, str], Tensor] = {}

    def __getitem__(self, key: tuple[str, str]) -> Tensor:
        if key not in self._keys:
            raise KeyError(key)
        if key not in self._known:
            self._known[key] = _interpolate(self._samples_of(key)[self._rows], self._recorded, self._time)
        return self._known[key]

    def __iter__(self):
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)


def _mount(log: Rollout) -> tuple[str, float, float]:
    """The mount of the robot, and the roll and pitch of a stand, to a hundredth of a radian."""
    tilt = stand_tilt(log) if log.metadata.mount == "stand" else None
    return log.metadata.mount, *(tilt or (0.0, 0.0))


def _control_period(log: Rollout) -> float:
    """Time between commands to a robot [s] from the metadata; the usual time if it is nearly equal, or for a bench.

    Logs are simulated together if it is equal to a hundredth of a millisecond: commands are applied at their time
    stamps.
    """
    period = 1.0 / float(log.metadata.extra.get("control_rate", log.metadata.rate))
    usual = abs(period - CONTROL_PERIOD) < SAME_RATE * period
    return CONTROL_PERIOD if usual or log.metadata.mount == "pendulum" else round(period, 5)


def _fallback(command: str, log: Rollout) -> ArrayLike:
    """Value of a command without a channel in the log; NaN if only the model defines it."""
    if command == "torque_enable":
        return 1.0
    if command == "bus_voltage" and log.metadata.battery is not None:
        return log.metadata.battery * log.robot.supply_shares[log.robot.indices(log.joints)]
    return gain_of(log) if command == "firmware_gain" else np.nan


def gain_of(log: Rollout) -> ArrayLike:
    """Gain of the servos' position loop from the log or otherwise from their makes, [joint]; NaN if outside the
    servo."""
    laws = [make.position_law for make in map(log.robot.servo, log.joints) if make.loop == "firmware"]
    return log.metadata.firmware_gain or [law.gain.si for law in laws if law] or np.nan


def _interpolate(values: Tensor, recorded: np.ndarray, time: np.ndarray) -> Tensor:
    """Linear interpolation of ``[candidate, sample, ...]`` to other times, ``[candidate, time, ...]``."""
    if len(recorded) >= len(time) and np.allclose(recorded[: len(time)], time, atol=2e-4):
        return values[:, : len(time)]
    step = recorded[1] - recorded[0]
    left = np.clip((time / step).astype(int), 0, len(recorded) - 2)
    weight = torch.from_numpy(time / step - left).view(1, -1, *([1] * (values.ndim - 2)))
    return values[:, left] * (1 - weight) + values[:, left + 1] * weight
