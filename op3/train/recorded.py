"""Recorded logs as transitions to learn from."""

from typing import Any

import torch
from tensordict import TensorDict

from op3.rollout import Rollout


def transitions(log: Rollout) -> TensorDict:
    """The policy steps of a log of one episode, with the keys of training.

    Args:
        log: log with the channels ``policy/observation``, ``policy/action`` and ``policy/reward``.

    Returns:
        [1, time] for `op3.train.OffPolicy.store`. A log does not contain the state after the last step: the last step
        is kept if the robot fell, because no value follows, and omitted otherwise.

    Raises:
        ValueError: if a channel is missing.
    """
    names = ("observation", "action", "reward")
    if missing := [name for name in names if ("policy", name) not in log.channels]:
        raise ValueError(f"the log has no policy/{missing[0]}; record it with `record_episodes` or while deploying")
    ticks = round(log.metadata.rate / (log.metadata.policy_rate or log.metadata.rate))
    steps = {name: log.data["policy", name][::ticks].float() for name in names}
    count, fallen = len(steps["action"]), bool(log.metadata.fallen)
    ends = torch.arange(count)[:, None] == count - 1
    following = torch.cat([steps["observation"][1:], steps["observation"][-1:]])
    after = {"observation": following, "reward": steps["reward"], "terminated": ends & fallen, "done": ends}
    whole = TensorDict({"observation": steps["observation"], "action": steps["action"], "next": after}, [count])
    kept: Any = whole if fallen else whole[:-1]
    kept["next", "done"][-1] = True
    return kept[None]
