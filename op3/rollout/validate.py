"""Basic checks of every log on construction: shapes, finite numbers, increasing time.

`op3.rollout.health` checks whether the values are plausible.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from op3.rollout.errors import LogError
from op3.rollout.metadata import OUTCOMES, Metadata
from op3.rollout.schema import CHANNELS, Channel, Key, column_names, key_name

GAP_INTERVALS, GAP = 10.0, 0.15
"""A gap is an interval of at least this multiple of the usual one and at least this length [s]."""

INSTANT = 1e-9
"""Smallest time between two rows [s]: below it, rates are not finite."""


def check_schema(tensors: Mapping[Key, Any], batch: Sequence[int], metadata: Metadata) -> None:
    """Raise `LogError` if channels do not have the shapes and values that the schema requires.

    Args:
        tensors: Channels by key, [*batch, last axis].
        batch: [time] or [episode, time].
        metadata: Metadata with the joint names.
    """
    batch = list(batch)
    if len(batch) not in (1, 2) or 0 in batch:
        raise LogError(f"the batch size is {batch}", "use batch size [time] or [episode, time] with at least one row")
    for key in tensors:
        known_channel(key)
    for key, channel in CHANNELS.items():
        if key in tensors:
            _check_tensor(channel, tensors[key], batch, metadata)
            check_values(channel, by_episode(tensors[key]), metadata)
        elif channel.required:
            column = column_names(channel, metadata.joints)[0]
            raise LogError("this required channel is missing", f"add {key_name(key)} [{channel.unit}]", column=column)
    episodes = batch[0] if len(batch) == 2 else None
    for name in OUTCOMES:
        value = getattr(metadata, name)
        if isinstance(value, tuple) and len(value) != episodes:
            problem = f"there are {len(value)} values for {episodes or 'a log without'} episodes"
            raise LogError(problem, "give one value per episode, or one for all", column=f"field {name}")
    for episode, time in enumerate(by_episode(tensors["time"])[..., 0]):
        check_time(time, episode if episodes and episodes > 1 else None)


def known_channel(key: Key) -> Channel:
    """The channel of a key; raises `LogError` for an unknown key."""
    if key not in CHANNELS:
        known = ", ".join(key_name(k) for k in CHANNELS)
        raise LogError(f"unknown channel {key_name(key)!r}", f"the channels are {known}")
    return CHANNELS[key]


def width_of(channel: Channel, metadata: Metadata) -> int | None:
    """Length of a channel's last axis; None if any length is allowed."""
    return {"scalar": 1, "joint": len(metadata.joints), "imu3": 3}.get(channel.axes)


def by_episode(tensor: torch.Tensor) -> np.ndarray:
    """A channel as [episode, time, last axis]."""
    array: np.ndarray = tensor.detach().numpy()
    return array if array.ndim == 3 else array[None]


def _check_tensor(channel: Channel, value: object, batch: list[int], metadata: Metadata) -> None:
    column = channel.name
    if not isinstance(value, torch.Tensor) or value.device.type != "cpu":
        raise LogError("the channel is not a CPU tensor", "convert it with .cpu()", column=column)
    dtype = torch.bool if channel.key == "done" else torch.float64
    if value.dtype != dtype:
        raise LogError(f"the dtype is {value.dtype}", f"convert it to {dtype}", column=column)
    wanted = [*batch, width_of(channel, metadata) or max(1, *value.shape[-1:])]
    if list(value.shape) != wanted:
        problem = f"the shape is {list(value.shape)} instead of {wanted}"
        raise LogError(problem, "give a row for each time, and a number for each joint or other name", column=column)


def check_values(channel: Channel, values: np.ndarray, metadata: Metadata, before: int = 0) -> None:
    """Raise `LogError` if a value [episode, time, last axis] is impossible for the channel.

    Args:
        channel: Channel of the values.
        values: Values to check.
        metadata: Metadata with the joint names.
        before: Number of rows before the values.
    """
    if values.dtype == bool:
        return
    quantity = channel.quantity
    repair = "repair or remove the row, and omit a channel that was never measured"
    rules = [(~np.isfinite(values), "is not a finite number", repair)]
    if quantity.nonnegative:
        rules.append((values < 0, "is negative", "give at least 0"))
    if quantity.binary:
        rules.append(((values != 0) & (values != 1), quantity.mistake, quantity.remedy))
    for wrong, problem, remedy in rules:
        if wrong.any():
            episode, row, index = (int(i) for i in np.argwhere(wrong)[0])
            raise LogError(
                f"{values[episode, row, index]:.10g} {problem}",
                remedy,
                column=column_names(channel, metadata.joints, values.shape[-1])[index],
                row=before + row + 1,
                episode=episode if len(values) > 1 else None,
            )


def check_time(time: np.ndarray, episode: int | None = None) -> None:
    """Raise `LogError` if a clock [time] is empty, not finite or not strictly increasing."""
    if not len(time):
        raise LogError("there are no rows", "record at least one row", row="row 1")
    if not np.isfinite(time).all():
        row = int(np.isfinite(time).argmin()) + 1
        raise LogError("the time is not a finite number", "remove the row", column="time", row=row)
    steps = np.diff(time)
    later = steps > INSTANT
    if later.all():
        return
    row = int(later.argmin())
    if steps[row] >= 0:
        problem, remedy = f"{time[row]:.10g} s repeats the time of row {row + 1}", "remove the duplicated row"
        if (more := int((~later).sum())) > len(time) // 20:
            problem += f", as in {more} rows in total"
            remedy = "write times with more digits (float32 is too coarse for Unix time), or write every row only once"
    else:
        problem = f"time decreases from {time[row]:.10g} s to {time[row + 1]:.10g} s"
        remedy = "sort the rows, or write `split: true` into the log's YAML if new recordings start there"
        if -86400 <= steps[row] < -86340:
            remedy = "the log passes midnight: write dates as well, or add 86400 s to the times after it"
    raise LogError(problem, remedy, column="time", row=row + 2, episode=episode)


def holes(time: np.ndarray) -> np.ndarray:
    """Rows before which time jumps forwards or backwards, counted from 0."""
    steps = np.diff(time)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return np.flatnonzero((steps > max(GAP_INTERVALS * usual, GAP)) | (steps < 0)) + 1
