"""How much of a change that windows ask for free runs can bear.

Windows of a fraction of a second tell what acts on a joint, but hardly how a whole closed loop answers it: a lag of
15 ms that is taken for 17 sets a servo's loop swinging that does not swing on the robot. Before what was named is left
out for that, free runs of the fitted logs say how far from the base towards it a model may go.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from op3.diagnose.free_run import settle_time
from op3.diagnose.show import with_whole_limbs
from op3.identify.loss import TrajectoryLoss
from op3.rollout import Rollout
from op3.servo import Estimate, RobotModel
from op3.tasks import Replay

SHARES = (0.2, 0.4, 0.6, 0.8)
"""Shares of the way from the base to the model with what was named that are tried."""

MOST_LOGS = 6
"""Fitted logs that are run freely, the first ones."""


def softened(base: RobotModel, model: RobotModel, logs: Sequence[Rollout]) -> list[tuple[RobotModel, float]]:
    """Models between base and model, with their shares of the way; first what free runs reproduce the logs best with.

    Args:
        base: without what was named.
        model: with it.
        logs: that were fitted; the first `MOST_LOGS` are run.

    Returns:
        Those that are better than the base.
    """
    whole = [with_whole_limbs(log) for log in logs[:MOST_LOGS]]
    joints = whole[0].joints
    shares = torch.tensor([0.0, *SHARES], dtype=torch.float64)
    values = _between(base, model, joints, shares)
    loss = TrajectoryLoss(tuple(logs[0].joints))(
        Replay(whole, settle=settle_time(logs), num_threads=1).run(model, values, len(shares))
    )
    loss = torch.nan_to_num(loss, nan=torch.inf)
    better = [int(i) for i in loss.argsort() if loss[i] < loss[0]]
    return [
        (
            model.with_values({name: Estimate.of_row(value[i], joints) for name, value in values.items()}),
            float(shares[i]),
        )
        for i in better
    ]


def _between(base: RobotModel, model: RobotModel, joints: Sequence[str], shares: Tensor) -> dict[str, Tensor]:
    """Parameters of models on the way, ``[share, joint]``; what an effect lacks in the base counts as neutral there.

    Parameters without a neutral value, such as a period, are the model's own all the way.
    """
    there, here = model.tensors(joints), base.tensors(joints)
    result = {}
    for name, known in model.parameters().items():
        if model.estimate(name).by:
            continue  # differs by a field of the metadata: stays as it was found
        start = here.get(name)
        if start is None:
            start = there[name] if known.neutral is None else torch.full_like(there[name], known.neutral)
        start, end = torch.broadcast_tensors(start, there[name])
        result[name] = start + shares[:, None] * (end - start)
    return result
