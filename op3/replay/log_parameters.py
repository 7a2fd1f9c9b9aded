"""Parameters for every log: values of candidates, and values under the log's conditions."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.servo.conditions import split_name


def parameters_per_log(
    model: RobotModel, parameters: Mapping[str, Tensor], logs: Sequence[Rollout], candidates: int
) -> dict[str, Tensor]:
    """Parameters of simulation ``c * len(logs) + l``, which is candidate c on log l.

    A value under a condition, from the model or the arguments, replaces the shared value if the condition holds.

    Args:
        model: model with all other conditional values.
        parameters: values by name, possibly with a condition: ``[candidate]`` or ``[candidate, joint]`` or a number.

    Returns:
        Values by name without conditions, ``[candidate * log]`` or ``[candidate * log, joint]`` or a number.

    Raises:
        ValueError: if a parameter has not one value per candidate, or a condition names an unknown field.
    """
    shared = {name: torch.as_tensor(v, dtype=torch.float64) for name, v in parameters.items() if "@" not in name}
    given = {name: torch.as_tensor(v, dtype=torch.float64) for name, v in parameters.items() if "@" in name}
    result = {name: _per_log(value, candidates, len(logs)) for name, value in shared.items()}
    bases = {split_name(name)[0] for name in given} | {n for n, estimate in model.estimates.items() if estimate.by}
    for base in sorted(bases):
        start = shared.get(base, model.tensors(logs[0].joints)[base])
        start = start.view(-1, 1) if start.ndim < 2 else start
        # [candidate, log, joint]
        value = start[:, None].expand(candidates, len(logs), start.shape[-1]).clone()
        for row, log in enumerate(logs):
            metadata = vars(log.metadata)
            value[:, row] = _special(model, base, metadata, value[:, row])
            for name, special in given.items():
                other, condition = split_name(name)
                if other == base and condition is not None and condition.joint is None and condition.holds(metadata):
                    value[:, row] = special.view(-1, 1) if special.ndim < 2 else special
        value = _per_joint(base, value, given, logs[0].joints)
        result[base] = value.flatten(0, 1)
    return result


def _per_joint(base: str, value: Tensor, given: Mapping[str, Tensor], joints: Sequence[str]) -> Tensor:
    """Values ``[candidate, log, joint]`` with those that are given for single joints."""
    for name, special in given.items():
        other, condition = split_name(name)
        if other != base or condition is None or condition.joint is None:
            continue
        if condition.joint not in joints:
            raise ValueError(f"{name}: unknown joint {condition.joint!r}; the logs have {', '.join(joints)}")
        if special.numel() not in (1, len(value)):
            raise ValueError(f"{name}: one joint takes one value per candidate ({len(value)}), got {special.numel()}")
        value = value.expand(*value.shape[:2], len(joints)).clone()
        value[..., joints.index(condition.joint)] = special.reshape(-1, 1)
    return value


def _special(model: RobotModel, base: str, metadata: Mapping, otherwise: Tensor) -> Tensor | float:
    """The model's value under the condition that holds, if any."""
    by = model.estimates[base].by if base in model.estimates else {}
    return next((special.value for condition, special in by.items() if condition.holds(metadata)), otherwise)


def _per_log(value: Tensor, candidates: int, logs: int) -> Tensor:
    """``[candidate, ...]`` repeated so that each candidate's logs have its value, ``[candidate * log, ...]``."""
    if value.ndim == 0:
        return value
    if len(value) != candidates:
        raise ValueError(f"a parameter must have one value per candidate ({candidates}), got {len(value)}")
    return value.repeat_interleave(logs, dim=0)
