"""Checks of a log against the channel table, with the first offence named by column and row.

`check_schema` asks for what every consumer relies on (shapes, finite numbers, increasing time) and runs
whenever a `Rollout` is made. Whether the numbers can be right is asked by `op3.rollout.health`.
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
    if channel.quantity.nonnegative:
        name, unit = key_name(channel.key), channel.unit
        why, mend = "{} " + f"{unit} is negative", f"write {name} as a number of at least 0"
        _fail(values < 0, values, channel, metadata, source, why, mend)
    if channel.quantity.binary:
        bad = (values != 0) & (values != 1)
        _fail(bad, values, channel, metadata, source, "{} " + channel.quantity.mistake, channel.quantity.remedy)


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
