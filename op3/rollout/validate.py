"""Checks of a log against the channel table, with the first offence named by column and row.

`check_schema` asks for what every consumer relies on (shapes, finite numbers, increasing time) and runs
whenever a `Rollout` is made. `check_units` asks whether the numbers can be SI at all and runs on everything
that comes from outside; a simulation that throws its robot about is not asked.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase

from op3.rollout.errors import LogError
from op3.rollout.metadata import Metadata
from op3.rollout.schema import CHANNELS, Channel, Key, column_names, key_name

Source = str | Path | None

RATE_TOLERANCE = 0.1
"""Largest relative difference between the clock and the metadata's rate."""


def check_schema(data: TensorDictBase, metadata: Metadata, source: Source = None) -> None:
    """Raise `LogError` unless `data` has the shape and the sanity the schema promises.

    Args:
        data: TensorDict of batch size [time] or [episode, time].
        metadata: Its metadata; gives the joint axis.
        source: Named in the error.
    """
    if len(data.batch_size) not in (1, 2) or 0 in data.batch_size:
        remedy = "shape the log [time] or [episode, time] with at least one row"
        raise LogError(f"the batch size is {list(data.batch_size)}", remedy, source=source)
    present = set()
    for key in data.keys(True, True):
        present.add(_check_tensor(key, data[key], data, metadata, source).key)
    for channel in CHANNELS.values():
        if channel.required and channel.key not in present:
            remedy = f"add {key_name(channel.key)} [{channel.unit}]"
            column = column_names(channel, metadata.joints)[0]
            raise LogError("this required channel is missing", remedy, source=source, column=column)
    for name in ("travelled_distance", "episode_duration", "fallen"):
        value = getattr(metadata, name)
        episodes = data.batch_size[0] if len(data.batch_size) == 2 else None
        if isinstance(value, tuple) and len(value) != episodes:
            remedy = "give one value per episode, or one for all"
            problem = f"{len(value)} values for {episodes or 'a log without'} episodes"
            raise LogError(problem, remedy, source=source, column=f"field {name}")
    for key in CHANNELS:
        if key in present:
            check_values(CHANNELS[key], _values(data, key), metadata, source)
    _check_time(_values(data, "time"), source)


def check_units(data: TensorDictBase, metadata: Metadata, source: Source = None) -> None:
    """Raise `LogError` where numbers cannot be in the schema's units, or the clock contradicts the rate.

    Assumes `check_schema` has passed. The accelerometer is judged by its median magnitude and the velocity
    by its slope against the derivative of the position, so that an impact or a noisy sample is no offence.
    """
    for key, channel in CHANNELS.items():
        if key in data.keys(True, True):
            _check_bound(channel, _values(data, key), metadata, source)
    _check_rate(_values(data, "time"), metadata, source)
    _check_gravity(data, metadata, source)
    _check_velocity(data, metadata, source)


def _values(data: TensorDictBase, key: Key) -> np.ndarray:
    """A channel as [episode, time, last axis]."""
    array: np.ndarray = data.get(key).detach().numpy()
    return array if array.ndim == 3 else array[None]


def _check_tensor(key: Key, value: object, data: TensorDictBase, metadata: Metadata, source: Source) -> Channel:
    channel = CHANNELS.get(key)
    if channel is None:
        known = ", ".join(key_name(k) for k in CHANNELS)
        raise LogError(f"unknown channel {key_name(key)!r}", f"the channels are {known}", source=source)
    column = key_name(channel.key)
    if not isinstance(value, torch.Tensor) or value.device.type != "cpu":
        raise LogError("the channel is not a CPU tensor", "convert it with .cpu()", source=source, column=column)
    dtype = torch.bool if channel.key == "done" else torch.float64
    if value.dtype != dtype:
        remedy = f"convert it to {dtype}"
        raise LogError(f"the dtype is {value.dtype}", remedy, source=source, column=column)
    width = {"scalar": 1, "joint": len(metadata.joints), "imu3": 3}.get(channel.axes, max(value.shape[-1:] or (0,)))
    wanted = [*data.batch_size, max(width, 1)]
    if list(value.shape) != wanted:
        problem = f"the shape is {list(value.shape)} where {wanted} belongs"
        remedy = "give the channel one row per time and one entry per name on its last axis"
        raise LogError(problem, remedy, source=source, column=column)
    return channel


def _fail(bad: np.ndarray, values: np.ndarray, channel: Channel, metadata: Metadata, source: Source, why, mend):
    """Raise for the first true entry of `bad` [episode, time, last axis]; `why` formats its value."""
    if not bad.any():
        return
    episode, row, index = (int(i) for i in np.argwhere(bad)[0])
    raise LogError(
        why.format(f"{values[episode, row, index]:.10g}"),
        mend,
        source=source,
        column=column_names(channel, metadata.joints, values.shape[-1])[index],
        row=row + 1,
        episode=episode if len(values) > 1 else None,
    )


def check_values(channel: Channel, values: np.ndarray, metadata: Metadata, source: Source = None) -> None:
    """Raise `LogError` unless every value [episode, time, last axis] is possible for the channel."""
    if values.dtype == bool:
        return
    why = "{} is not a finite number"
    mend = "repair or leave out the row, and leave a channel that was never measured absent"
    _fail(~np.isfinite(values), values, channel, metadata, source, why, mend)
    if channel.nonnegative:
        name, unit = key_name(channel.key), channel.unit
        why, mend = "{} " + f"{unit} is negative", f"write {name} as a number of at least 0"
        _fail(values < 0, values, channel, metadata, source, why, mend)
    if channel.binary:
        bad = (values != 0) & (values != 1)
        _fail(bad, values, channel, metadata, source, "{} " + channel.mistake, channel.remedy)


def _check_time(time: np.ndarray, source: Source) -> None:
    steps = np.diff(time[..., 0], axis=-1)
    if (steps > 0).all():
        return
    episode, row = (int(i) for i in np.argwhere(~(steps > 0))[0])
    before, now = time[episode, row, 0], time[episode, row + 1, 0]
    if now == before:
        problem, remedy = f"{now:.10g} s repeats the time of row {row + 1}", "remove the duplicated row"
    else:
        problem = f"time goes back from {before:.10g} s to {now:.10g} s"
        remedy = "sort the rows, or split the file where a new recording starts"
    where = episode if len(time) > 1 else None
    raise LogError(problem, remedy, source=source, column="time", row=row + 2, episode=where)


def _check_bound(channel: Channel, values: np.ndarray, metadata: Metadata, source: Source) -> None:
    if channel.binary or not np.isfinite(channel.bound):
        return
    why = "{} " + f"is beyond {channel.bound:g} {channel.unit}".rstrip() + f" and {channel.mistake}"
    _fail(np.abs(values) > channel.bound, values, channel, metadata, source, why, channel.remedy)


def _check_rate(time: np.ndarray, metadata: Metadata, source: Source) -> None:
    if time.shape[1] < 2:
        return
    steps = np.diff(time[..., 0], axis=-1)
    # The mean suits a clock that alternates between two intervals, the median one with gaps.
    interval, mean = float(np.median(steps)), float(np.mean(steps))
    if min(abs(interval * metadata.rate - 1), abs(mean * metadata.rate - 1)) <= RATE_TOLERANCE:
        return
    off = np.abs(steps * metadata.rate - 1) > RATE_TOLERANCE
    ratio = interval * metadata.rate
    unit = next((u for scale, u in ((1e3, "milli"), (1e6, "micro"), (1e9, "nano")) if 0.5 < ratio / scale < 2), None)
    problem = f"the median interval of {interval:.6g} s is {1 / interval:.6g} Hz, but the metadata says rate: "
    problem += f"{metadata.rate:g} Hz"
    remedy = f"the time looks like {unit}seconds, convert it to seconds" if unit else "correct the rate or the time"
    raise LogError(problem, remedy, source=source, column="time", row=int(np.argwhere(off)[0][1]) + 2)


def _check_gravity(data: TensorDictBase, metadata: Metadata, source: Source) -> None:
    if ("imu", "linear_acceleration") not in data.keys(True, True):
        return
    force = _values(data, ("imu", "linear_acceleration"))
    magnitude = float(np.median(np.linalg.norm(force, axis=-1)))
    if 0.5 < magnitude < 2 or magnitude > 200:
        unit = "g" if magnitude < 2 else "mg or raw counts"
        problem = f"the median specific force is {magnitude:.4g} m/s2, which looks like {unit}"
        remedy = "convert to m/s2 (a robot at rest reads 9.81)"
        raise LogError(problem, remedy, source=source, column="imu.acc_x", row=1)


def _check_velocity(data: TensorDictBase, metadata: Metadata, source: Source) -> None:
    """Compare the velocity with the derivative of the position, where they clearly belong together."""
    if ("joint", "velocity") not in data.keys(True, True) or data.batch_size[-1] < 20:
        return
    time, position = _values(data, "time"), _values(data, ("joint", "position"))
    velocity = _values(data, ("joint", "velocity"))
    slope_of_position = np.diff(position, axis=1) / np.diff(time, axis=1)
    mean_velocity = (velocity[:, 1:] + velocity[:, :-1]) / 2
    product = (slope_of_position * mean_velocity).sum((0, 1))
    squares = (slope_of_position**2).sum((0, 1)), (mean_velocity**2).sum((0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = product / np.sqrt(squares[0] * squares[1])
        slope = product / squares[0]
    wrong = np.flatnonzero((np.abs(correlation) > 0.9) & ((slope > 5) | (slope < 0.2)))
    if wrong.size:
        joint = int(wrong[0])
        problem = f"the velocity is {slope[joint]:.3g} times the change of position per second"
        remedy = "convert both to radians and the same sign (57.3 is degrees per second, 9.55 is rpm)"
        column = column_names(CHANNELS["joint", "velocity"], metadata.joints)[joint]
        row = int(np.abs(mean_velocity[0, :, joint]).argmax()) + 1
        raise LogError(problem, remedy, source=source, column=column, row=row)
