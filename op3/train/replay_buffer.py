"""Transitions of many environments side by side, and n-step returns from them."""

from typing import NamedTuple

import torch
from torch import Tensor


class Batch(NamedTuple):
    """A batch for one update.

    Attributes:
        observation: [batch, observation].
        action: [batch, action].
        reward: [batch], discounted sum over the n steps.
        discount: [batch], of the value after them: 0 where the episode terminated.
        next_observation: [batch, observation], after the n steps or the episode's last one.
    """

    observation: Tensor
    action: Tensor
    reward: Tensor
    discount: Tensor
    next_observation: Tensor


class ReplayBuffer:
    """A ring of rows, each one step of all environments; batches look ahead n rows for their returns.

    TorchRL's buffers sample single transitions, whose n-step returns must be formed before they are stored; here
    n can look over the border of two rollouts, and sampling is five gathers.

    Args:
        capacity: transitions kept; the oldest are overwritten.
        environments: side by side.
        observation_size: numbers in an observation.
        action_size: numbers in an action.
        device: of the tensors.
    """

    def __init__(
        self,
        capacity: int,
        environments: int,
        observation_size: int,
        action_size: int,
        device: torch.device | str = "cpu",
    ):
        self.rows = self.rows_of(capacity, environments)
        self.environments = environments
        shape = (self.rows, environments)
        self.observation = torch.zeros(*shape, observation_size, device=device)
        self.action = torch.zeros(*shape, action_size, device=device)
        self.reward = torch.zeros(shape, device=device)
        self.next_observation = torch.zeros(*shape, observation_size, device=device)
        self.terminated = torch.zeros(shape, dtype=torch.bool, device=device)
        self.done = torch.zeros(shape, dtype=torch.bool, device=device)
        self.filled = 0
        self.next_row = 0

    def __len__(self) -> int:
        return self.filled * self.environments

    @staticmethod
    def rows_of(capacity: int, environments: int) -> int:
        """Steps of every environment that a buffer of so many transitions holds.

        Raises:
            ValueError: if these are under two.
        """
        if capacity < 2 * environments:
            raise ValueError(f"a buffer of {capacity} transitions holds under two steps of {environments} environments")
        return capacity // environments

    def extend(
        self,
        observation: Tensor,
        action: Tensor,
        reward: Tensor,
        next_observation: Tensor,
        terminated: Tensor,
        done: Tensor,
    ) -> None:
        """Append a rollout.

        Args:
            observation: [time, env, observation].
            action: [time, env, action].
            reward: [time, env].
            next_observation: [time, env, observation], of the step itself, before any reset.
            terminated: [time, env], whether nothing follows.
            done: [time, env], whether the episode ended, by termination or by time.
        """
        steps = reward.shape[0]
        if steps > self.rows:
            raise ValueError(f"a rollout of {steps} steps does not fit in a buffer of {self.rows}")
        rows = (self.next_row + torch.arange(steps)) % self.rows
        given = (observation, action, reward, next_observation, terminated, done)
        for store, values in zip(self._stores(), given, strict=True):
            store[rows] = values.to(store)
        self.next_row = (self.next_row + steps) % self.rows
        self.filled = min(self.filled + steps, self.rows)

    def cut(self) -> None:
        """End every running episode by time at the last row, because the environments start anew."""
        if self.filled:
            self.done[(self.next_row - 1) % self.rows] = True

    def sample(self, size: int, steps: int, discount: float, generator: torch.Generator) -> Batch:
        """Transitions drawn evenly, with returns over up to `steps` steps of the same episode.

        Args:
            size: of the batch.
            steps: n of the n-step return.
            discount: per step.
            generator: of the draws.
        """
        usable = self.filled - steps + 1
        if usable < 1:
            raise ValueError(f"{self.filled} steps are stored, too few for returns over {steps}")
        device = self.reward.device
        oldest = (self.next_row - self.filled) % self.rows
        row = torch.randint(usable, (size,), generator=generator, device=device).add_(oldest)
        environment = torch.randint(self.environments, (size,), generator=generator, device=device)
        first = row.remainder(self.rows).mul_(self.environments).add_(environment)
        reward, done = self.reward.view(-1), self.done.view(-1)
        last, total = first, reward[first]
        scale = torch.full_like(total, discount)
        alive = ~done[first]
        for number in range(1, steps):
            index = (row + number).remainder_(self.rows).mul_(self.environments).add_(environment)
            last = torch.where(alive, index, last)
            total = total + torch.where(alive, scale * reward[index], 0.0)
            scale = torch.where(alive, scale * discount, scale)
            alive = alive & ~done[index]
        scale = torch.where(self.terminated.view(-1)[last], 0.0, scale)
        observation, next_observation = self.observation.flatten(0, 1), self.next_observation.flatten(0, 1)
        return Batch(
            observation.index_select(0, first),
            self.action.flatten(0, 1).index_select(0, first),
            total,
            scale,
            next_observation.index_select(0, last),
        )

    def state_dict(self) -> dict[str, Tensor | int]:
        """The rows in use and where the ring stands."""
        stores = {name: getattr(self, name)[: self.filled].cpu() for name in _NAMES}
        return {**stores, "filled": self.filled, "next_row": self.next_row}

    def load_state_dict(self, state: dict[str, Tensor | int]) -> None:
        """The inverse of `state_dict`."""
        filled, next_row = int(state["filled"]), int(state["next_row"])
        for name, store in zip(_NAMES, self._stores(), strict=True):
            values = state[name]
            if not isinstance(values, Tensor) or filled > self.rows or values.shape[1:] != store.shape[1:]:
                raise ValueError(f"the stored replay buffer's {name} does not fit this run; use the settings it had")
            store[:filled] = values.to(store)
        self.filled, self.next_row = filled, next_row

    def _stores(self) -> tuple[Tensor, ...]:
        return tuple(getattr(self, name) for name in _NAMES)


_NAMES = ("observation", "action", "reward", "next_observation", "terminated", "done")
