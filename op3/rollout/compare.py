"""How far two logs are apart, per channel and joint, with and without a shift in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from op3.rollout.errors import LogError
from op3.rollout.rollout import Rollout
from op3.rollout.schema import CHANNELS, Channel, Key, key_name, normal_key

_COMPARED = ("command", "joint", "imu")


@dataclass(frozen=True)
class ChannelError:
    """Differences b - a in one channel; arrays are [joint] or [axis] in the order of `names`.

    Attributes:
        key: The channel.
        unit: Unit of `rmse`, `largest` and `rmse_without_lag`.
        names: Joint names, or axis names.
        rmse: Root mean square difference.
        largest: Largest absolute difference.
        lag: Delay of b behind a that makes them most alike [s].
        rmse_without_lag: Root mean square difference after taking out that delay.
    """

    key: Key
    unit: str
    names: tuple[str, ...]
    rmse: np.ndarray
    largest: np.ndarray
    lag: np.ndarray
    rmse_without_lag: np.ndarray


@dataclass(frozen=True)
class Comparison:
    """Two logs compared over the time they share.

    Attributes:
        channels: Result per channel that both logs have.
        start: First shared time [s].
        end: Last shared time [s].
        rows: Rows of a that were compared, over all episodes.
    """

    channels: dict[Key, ChannelError]
    start: float
    end: float
    rows: int

    def __getitem__(self, key: str | tuple[str, ...]) -> ChannelError:
        return self.channels[normal_key(key)]

    def table(self) -> list[dict[str, object]]:
        """One plain row per channel and name, worst first within a channel."""
        rows = []
        for error in self.channels.values():
            for i in np.argsort(-error.rmse, kind="stable"):
                rows.append(
                    {
                        "channel": key_name(error.key),
                        "name": error.names[i],
                        "unit": error.unit,
                        "rmse": float(error.rmse[i]),
                        "largest": float(error.largest[i]),
                        "lag": float(error.lag[i]),
                        "rmse_without_lag": float(error.rmse_without_lag[i]),
                    }
                )
        return rows


def compare(a: Rollout, b: Rollout, max_lag: float = 0.1) -> Comparison:
    """Compare b with a on a's time, channel by channel.

    Sampled signals of b are interpolated linearly, commands hold until the next row, and angles of the IMU
    are taken around the circle. Joints are matched by name. Batches are compared episode by episode and
    pooled.

    Args:
        a: Reference.
        b: The other log.
        max_lag: Largest delay considered, either way [s]; at most a quarter of the shared time is used.
    """
    if set(a.joints) != set(b.joints):
        odd = ", ".join(sorted(set(a.joints) ^ set(b.joints)))
        raise LogError(f"only one of the two logs has {odd}", "compare logs of the same joints")
    episodes = list(zip(_episodes(a), _episodes(b), strict=False))
    if len(_episodes(a)) != len(_episodes(b)):
        problem = f"one log has {len(_episodes(a))} episodes and the other {len(_episodes(b))}"
        raise LogError(problem, "compare the same number of episodes")
    order = [b.joints.index(joint) for joint in a.joints]
    spans = [_span(ta, tb) for (ta, _), (tb, _) in episodes]
    channels = {}
    for key, channel in CHANNELS.items():
        if isinstance(key, tuple) and key[0] in _COMPARED and key in a and key in b:
            pick = order if channel.axes == "joint" else [0, 1, 2]
            pairs = [(ta, va[key], tb, vb[key][:, pick]) for (ta, va), (tb, vb) in episodes]
            names = a.joints if channel.axes == "joint" else channel.axis_names
            channels[key] = _channel_error(channel, names, pairs, spans, max_lag)
    rows = sum(int(((ta >= s) & (ta <= e)).sum()) for ((ta, _), _), (s, e) in zip(episodes, spans, strict=True))
    return Comparison(channels, min(s for s, _ in spans), max(e for _, e in spans), rows)


def _episodes(rollout: Rollout) -> list[tuple[np.ndarray, dict[Key, np.ndarray]]]:
    """Time [time] and channels [time, last axis] of each episode."""
    arrays = {key: rollout.array(key) for key in rollout.channels}
    if not rollout.batched:
        return [(arrays["time"][:, 0], arrays)]
    episodes = range(rollout.data.batch_size[0])
    return [(arrays["time"][i, :, 0], {k: v[i] for k, v in arrays.items()}) for i in episodes]


def _span(time_a: np.ndarray, time_b: np.ndarray) -> tuple[float, float]:
    start, end = max(time_a[0], time_b[0]), min(time_a[-1], time_b[-1])
    if not ((time_a >= start) & (time_a <= end)).any():
        problem = f"the logs share no time: {time_a[0]:g} to {time_a[-1]:g} s and {time_b[0]:g} to {time_b[-1]:g} s"
        raise LogError(problem, "shift one of them to a common start", column="time")
    return float(start), float(end)


def _channel_error(channel: Channel, names: tuple[str, ...], pairs, spans, max_lag: float) -> ChannelError:
    differences = []
    for (time_a, values_a, time_b, values_b), (start, end) in zip(pairs, spans, strict=True):
        inside = (time_a >= start) & (time_a <= end)
        differences.append(_sample(channel, time_b, values_b, time_a[inside]) - values_a[inside])
    difference = _around(channel, np.concatenate(differences))
    lag, rmse_without_lag = _best_lag(channel, pairs, spans, max_lag)
    return ChannelError(
        channel.key,
        channel.unit,
        tuple(names),
        np.sqrt((difference**2).mean(0)),
        np.abs(difference).max(0),
        lag,
        rmse_without_lag,
    )


def _sample(channel: Channel, time: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values [time, name] at other times; commands hold, signals are linear between rows."""
    if channel.hold:
        return values[np.clip(np.searchsorted(time, at, side="right") - 1, 0, None)]
    if channel.key == ("imu", "orientation"):
        values = np.unwrap(values, axis=0)
    if len(time) == 1:
        return np.repeat(values, len(at), axis=0)
    right = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    weight = ((at - time[right - 1]) / (time[right] - time[right - 1]))[:, None]
    # This form gives back the row itself, to the last bit, where the times agree.
    return np.where(weight == 1, values[right], values[right - 1] + weight * (values[right] - values[right - 1]))


def _around(channel: Channel, difference: np.ndarray) -> np.ndarray:
    """Differences of angles brought to [-pi, pi]."""
    if channel.key != ("imu", "orientation"):
        return difference
    return np.where(np.abs(difference) > np.pi, np.remainder(difference + np.pi, 2 * np.pi) - np.pi, difference)


def _best_lag(channel: Channel, pairs, spans, max_lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Delay of b [s] with the smallest mean square difference, per name, and the RMSE left with it.

    All delays are judged on the same rows of a, those that stay inside the shared time at every delay. The
    delays tried are a row apart; a parabola through the best three refines the delay.
    """
    reach = min(max_lag, *((end - start) / 4 for start, end in spans))
    step = min(float(np.median(np.diff(p[0]))) if len(p[0]) > 1 else np.inf for p in pairs)
    count = int(reach / step) if np.isfinite(step) else 0
    lags = step * np.arange(-count, count + 1) if count else np.zeros(1)
    inner = [(p[0] >= s + reach) & (p[0] <= e - reach) for p, (s, e) in zip(pairs, spans, strict=True)]
    if not any(i.any() for i in inner):
        lags, inner = np.zeros(1), [(p[0] >= s) & (p[0] <= e) for p, (s, e) in zip(pairs, spans, strict=True)]

    def squares(lag: float) -> np.ndarray:
        parts = [
            _sample(channel, tb, vb, ta[i] + lag) - va[i] for (ta, va, tb, vb), i in zip(pairs, inner, strict=True)
        ]
        return (_around(channel, np.concatenate(parts)) ** 2).mean(0)

    cost = np.stack([squares(lag) for lag in lags])
    # Of equal delays the one nearest to zero counts: a constant signal has no delay.
    by_size = np.argsort(np.abs(lags), kind="stable")
    best = by_size[cost[by_size].argmin(0)]
    lag, least = lags[best].copy(), cost.min(0)
    for name, i in enumerate(best):
        if 0 < i < len(lags) - 1 and not channel.hold:
            left, middle, right = cost[i - 1 : i + 2, name]
            curvature = left - 2 * middle + right
            if curvature <= 0:
                continue
            refined = float(lags[i] + step * (left - right) / (2 * curvature))
            refined_cost = squares(refined)[name]
            if refined_cost < least[name]:
                lag[name], least[name] = refined, refined_cost
    return lag, np.sqrt(least)
