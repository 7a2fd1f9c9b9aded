"""The policy that collects: a copy of the learner's, so that the learner may learn meanwhile."""

import copy
import math

import torch
from torch import Tensor

from op3.train.sac import SAC


class Explorer:
    """A frozen copy of a learner's policy with exploration of its own; robots explore more boldly from first to last.

    Args:
        sac: whose policy is copied.
        count: robots side by side.
        seed: of the exploration.
    """

    def __init__(self, sac: SAC, count: int, seed: int):
        self._sac = sac
        self._actor = copy.deepcopy(sac.actor).requires_grad_(False)
        self._normaliser = copy.deepcopy(sac.normaliser)
        self._ladder = torch.linspace(0.0, 1.0, count, device=sac.device)[:, None]
        self._noise = torch.ones(count, 1, device=sac.device)
        self._generator = torch.Generator(sac.device)
        self.restart(seed)

    def restart(self, seed: int) -> None:
        """Begin the exploration of another seed."""
        self._generator.manual_seed(seed)

    def follow(self, boldest: float) -> None:
        """Take over the learner's policy as it is now.

        Args:
            boldest: multiple of the policy's standard deviation with which the last robot explores; the first does
                with 1, the others between, evenly in the logarithm.
        """
        self._actor.load_state_dict(self._sac.actor.state_dict())
        self._normaliser.mean.copy_(self._sac.normaliser.mean)
        self._normaliser.scale.copy_(self._sac.normaliser.scale)
        self._noise = torch.exp(self._ladder * math.log(boldest))

    @torch.no_grad()
    def __call__(self, observation: Tensor) -> Tensor:
        """Actions [env, action] for observations [env, observation]."""
        sac = self._sac
        mean, log_std = self._actor(self._normaliser(observation.to(sac.device, torch.float32), sac.settings.clip))
        noise = torch.randn(mean.shape, generator=self._generator, device=sac.device)
        return torch.tanh(mean + self._noise * log_std.exp() * noise)
