"""Mean and scale of the observations, measured while collecting."""

import torch
from torch import Tensor

SMALLEST_SCALE = 0.01
"""Floor of the scale, in the unit of the observation: what hardly moved yet is not blown up."""


class Normaliser:
    """Mean and standard deviation of everything seen, by merging rollouts (Chan et al. 1979).

    Args:
        size: numbers in an observation.
        device: of mean and scale.
    """

    def __init__(self, size: int, device: torch.device | str = "cpu"):
        self.count = 0
        self.mean = torch.zeros(size, device=device)
        self.scale = torch.ones(size, device=device)
        self._mean = torch.zeros(size, dtype=torch.float64)
        self._squares = torch.zeros(size, dtype=torch.float64)

    def update(self, observation: Tensor) -> None:
        """Take observations [..., observation] into account."""
        values = observation.reshape(-1, observation.shape[-1]).to("cpu", torch.float64)
        new, total = len(values), self.count + len(values)
        mean = values.mean(0)
        difference = mean - self._mean
        self._squares += (values - mean).square().sum(0) + difference.square() * self.count * new / total
        self._mean += difference * new / total
        self.count = total
        deviation = (self._squares / total).sqrt().clamp(min=SMALLEST_SCALE)
        # in place: compiled code and the collector keep their hold on these tensors
        self.mean.copy_(self._mean)
        self.scale.copy_(deviation)

    def __call__(self, observation: Tensor, clip: float) -> Tensor:
        """clip((observation - mean) / scale)."""
        return ((observation - self.mean) / self.scale).clamp_(-clip, clip)

    def state_dict(self) -> dict[str, Tensor | int]:
        """Everything that `load_state_dict` needs to go on."""
        return {"count": self.count, "mean": self._mean, "squares": self._squares, "scale": self.scale.cpu()}

    def load_state_dict(self, state: dict[str, Tensor | int]) -> None:
        """The inverse of `state_dict`."""
        mean, squares, scale = (torch.as_tensor(state[name]) for name in ("mean", "squares", "scale"))
        self.count = int(state["count"])
        self._mean, self._squares = mean.clone(), squares.clone()
        self.mean.copy_(mean)
        self.scale.copy_(scale)
