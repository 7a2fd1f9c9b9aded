"""How far two logs are apart, per channel and joint, with and without a shift in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.rollout import Rollout
from op3.rollout.schema import CHANNELS, Channel

Pair = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Time [time] and values [time, name] of one log, and of the other, in one episode."""


@dataclass(frozen=True)
class ChannelError:
    """Differences b - a in one channel; arrays are [joint] or [axis] in the order of `names`.

    Attributes:
        unit: Unit of `rmse`, `largest` and `rmse_without_lag`.
        names: Joint names, or axis names.
        rmse: Root mean square difference.
        largest: Largest absolute difference.
        lag: Delay of b behind a that makes them most alike [s].
        rmse_without_lag: Root mean square difference after taking out that delay.
    """

    unit: str
    names: tuple[str, ...]
    rmse: np.ndarray
    largest: np.ndarray
    lag: np.ndarray
    rmse_without_lag: np.ndarray


def compare(a: Rollout, b: Rollout, max_lag: float = 0.1) -> dict[str, ChannelError]:
    """Compare b with a on a's time, channel by channel.

    Sampled signals of b are interpolated linearly, commands hold until the next row, and angles of the IMU
    are taken around the circle. Joints are matched by name. Batches are compared episode by episode and
    pooled.

    Args:
        a: Reference.
        b: The other log.
        max_lag: Largest delay considered, either way [s]; at most a quarter of the shared time is used.

    Returns:
        By channel that both logs have, such as `joint/position`.
    """
    if set(a.joints) != set(b.joints):
        odd = ", ".join(sorted(set(a.joints) ^ set(b.joints)))
        raise LogError(f"only one of the two logs has {odd}", "compare logs of the same joints")
    episodes = list(zip(a.episodes(), b.episodes(), strict=False))
    if len(a.episodes()) != len(b.episodes()):
        problem = f"one log has {len(a.episodes())} episodes and the other {len(b.episodes())}"
        raise LogError(problem, "compare the same number of episodes")
    order, channels = [b.joints.index(joint) for joint in a.joints], {}
    for key, channel in CHANNELS.items():
        if key[0] in ("command", "joint", "imu") and key in a and key in b:
            names, pick = (a.joints, order) if channel.axes == "joint" else (channel.axis_names, [0, 1, 2])
            pairs = [
                (x.array("time")[:, 0], x.array(key), y.array("time")[:, 0], y.array(key)[:, pick]) for x, y in episodes
            ]
            channels[channel.name] = _channel_error(channel, names, pairs, max_lag)
    return channels


def _channel_error(channel: Channel, names: tuple[str, ...], pairs: list[Pair], max_lag: float) -> ChannelError:
    spans = [_span(pair[0], pair[2]) for pair in pairs]
    reach = min(max_lag, *((end - start) / 4 for start, end in spans))
    step = min(float(np.median(np.diff(pair[0]))) if len(pair[0]) > 1 else np.inf for pair in pairs)
    lags = step * np.arange(-int(reach / step), int(reach / step) + 1) if reach > step else np.zeros(1)

    def differences(lag: float, margin: float) -> np.ndarray:
        """Of b so much later from a, [row, name], leaving out rows at both ends."""
        parts = []
        for (time, values, other_time, others), (start, end) in zip(pairs, spans, strict=True):
            inside = (time >= start + margin) & (time <= end - margin)
            parts.append(_sample(channel, other_time, others, time[inside] + lag) - values[inside])
        difference = np.concatenate(parts)
        circle = channel.name == "imu/orientation"
        return np.where(circle & (abs(difference) > np.pi), _wrapped(difference), difference)

    # all delays are judged on the same rows of a, those that stay inside the shared time at every delay
    cost = np.stack([(differences(lag, lags[-1]) ** 2).mean(0) for lag in lags])
    lag, least = np.zeros(len(names)), cost.min(0)
    by_size = np.argsort(np.abs(lags), kind="stable")  # of equal delays the one nearest to zero: a constant has none
    for name, best in enumerate(by_size[cost[by_size].argmin(0)]):
        lag[name] = lags[best]
        if channel.hold or not 0 < best < len(lags) - 1:
            continue
        left, middle, right = cost[best - 1 : best + 2, name]
        if left - 2 * middle + right > 0:  # the lowest point of a parabola through the best three
            refined = lags[best] + step * (left - right) / (2 * (left - 2 * middle + right))
            lower = float((differences(refined, lags[-1]) ** 2).mean(0)[name])
            if lower < least[name]:
                lag[name], least[name] = refined, lower
    every = differences(0.0, 0.0)
    rmse, largest = np.sqrt((every**2).mean(0)), np.abs(every).max(0)
    return ChannelError(channel.unit, tuple(names), rmse, largest, lag, np.sqrt(least))


def _span(time_a: np.ndarray, time_b: np.ndarray) -> tuple[float, float]:
    start, end = max(time_a[0], time_b[0]), min(time_a[-1], time_b[-1])
    if not ((time_a >= start) & (time_a <= end)).any():
        problem = f"the logs share no time: {time_a[0]:g} to {time_a[-1]:g} s and {time_b[0]:g} to {time_b[-1]:g} s"
        raise LogError(problem, "shift one of them to a common start", column="time")
    return float(start), float(end)


def _sample(channel: Channel, time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values [time, name] at other times; commands hold, signals are linear between rows."""
    if channel.hold:
        return values[np.clip(np.searchsorted(time, at, side="right") - 1, 0, None)]
    signal = np.unwrap(values, axis=0) if channel.name == "imu/orientation" else values
    return np.stack([np.interp(at, time, column) for column in signal.T], axis=1)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi
