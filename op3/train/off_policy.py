"""Algorithms that learn from a replay buffer, with any suitable loss of TorchRL."""

from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.transforms import MultiStepTransform, Transform
from torchrl.modules import ValueOperator
from torchrl.objectives import LossModule, SoftUpdate

from op3.common.settings import Count, NotNegative, Number, Positive, Share, Whole, settings
from op3.policy.mirror import Mirror
from op3.train.algorithm import NORMALISED, Algorithm, AlgorithmSettings, Measures
from op3.train.networks import QNetwork, bfloat16_is_faster

Bold = Annotated[Number, Field(ge=1)]


@settings("algorithm")
class OffPolicySettings(AlgorithmSettings):
    """Common settings of algorithms with a replay buffer; one step is one policy step of one environment.

    Attributes:
        layer_norm: whether the critics' hidden layers are normalised.
        n_step: steps of the return before it bootstraps from the critics.
        batch: transitions per update.
        actor_rate: learning rate of the policy.
        critic_rate: learning rate of the critics.
        target_rate: share by which the target critics approach the critics per update.
        actor_every: critic updates per policy update.
        actor_after: critic updates before the first policy update, so that it does not follow untrained critics.
        warmup: steps before the first update, taken by the untrained policy.
        noise: largest exploration of an environment, in multiples of the policy's standard deviation; those of the
            other environments lie between 1 and this value, evenly in the logarithm. Critics thus learn the value of
            larger actions.
        warmup_noise: largest exploration during the warm-up.
        updates_per_step: updates per step after the warm-up.
        buffer: transitions kept; the oldest are overwritten.
        checkpoint_buffer: whether checkpoints hold the buffer; without it, a resumed run starts with an empty buffer.
        normalisation: `running`: updated during the whole run; `fixed`: only during the warm-up.
        bfloat16: whether the critics multiply in bfloat16; None: if that is faster on this processor.
        mirrored: share of each batch that is replaced by its image in the robot's plane of symmetry.
    """

    layer_norm: bool = True
    n_step: Count = 3
    batch: Count = 256
    actor_rate: Positive = 3e-4
    critic_rate: Positive = 3e-4
    target_rate: Positive = 0.005
    actor_every: Count = 1
    actor_after: Whole = 0
    warmup: Whole = 5_000
    noise: Bold = 1.0
    warmup_noise: Bold = 1.0
    updates_per_step: NotNegative = 0.25
    buffer: Count = 300_000
    checkpoint_buffer: bool = True
    normalisation: Literal["running", "fixed"] = "running"
    bfloat16: bool | None = False
    mirrored: Share = 0.0


class OffPolicy(Algorithm):
    """Collects transitions in TorchRL's replay buffer and updates from it.

    A subclass defines `make_loss`, which returns one of TorchRL's losses; its entries ``loss_*`` are minimised
    together, the policy's only every `actor_every` updates.
    """

    Settings = OffPolicySettings

    def build(self) -> None:
        """Make loss, target networks and buffer."""
        self.loss = self.make_loss()
        self.targets = SoftUpdate(self.loss, tau=self.settings.target_rate)
        self.make_buffer()

    def make_loss(self) -> LossModule:
        """The loss for `stochastic_actor` and `critic`, with a value estimator for this discount."""
        raise NotImplementedError(f"{type(self).__name__} has no make_loss")

    def q_network(self) -> QNetwork:
        """A new Q function."""
        chosen = self.settings
        bfloat16 = bfloat16_is_faster(self.device) if chosen.bfloat16 is None else chosen.bfloat16
        hidden = chosen.critic_hidden or chosen.hidden
        return QNetwork(self.critic_input_size, self.action_size, hidden, chosen.layer_norm, bfloat16)

    def critic(self) -> ValueOperator:
        """A new Q function as TorchRL's losses expect it."""
        return ValueOperator(self.q_network(), in_keys=[NORMALISED, "action"])

    def make_buffer(self) -> None:
        """Make an empty buffer."""
        chosen = self.settings
        if chosen.buffer < 2 * self.environments:
            raise ValueError(
                f"buffer must hold two steps of {self.environments} environments or more, got {chosen.buffer}"
                " transitions"
            )
        self.steps = self.learned = self.stored = 0
        storage = IndexSelectStorage(chosen.buffer, device=self.device)
        self.buffer = ReplayBuffer(storage=storage, batch_size=chosen.batch)
        if self.mirror is not None and chosen.mirrored:
            self.buffer.append_transform(Mirrored(self.mirror, chosen.mirrored))
        self.buffer.append_transform(self.normalise)  # pyright: ignore[reportArgumentType]

    def optimise(self) -> None:
        """One optimiser, with separate rates for the critics and everything else."""
        chosen, critics, others = self.settings, [], []
        for name, parameter in self.loss.named_parameters():
            (critics if "value_network" in name else others).append(parameter)
        groups = [{"params": critics, "lr": chosen.critic_rate}, {"params": others, "lr": chosen.actor_rate}]
        self.optimisers["loss"] = torch.optim.Adam(groups, fused=True)

    def follow(self) -> None:
        """Copy the current policy to the explorer, with more noise during the warm-up."""
        self.explorer.follow(self.settings.warmup_noise if self.steps < self.settings.warmup else self.settings.noise)

    def restart(self, seed: int) -> None:
        """Restart all episodes; the latest steps are dropped because their n-step returns are incomplete."""
        super().restart(seed)
        self.multi_step = self.returns()

    def returns(self) -> MultiStepTransform:
        """The transform that computes n-step returns over consecutive rollouts of the same robots.

        End flags and observation come from the last of the n steps. By default TorchRL keeps the flags of the first
        step, which would add the value of the fallen state to a return that ends in a fall.
        """
        return MultiStepTransform(self.settings.n_step, self.settings.discount, done_keys=[])

    def take(self, rollout: TensorDictBase) -> Measures:
        """Store the transitions, with n-step returns, and update the normalisation."""
        if self.settings.normalisation == "running" or self.steps < self.settings.warmup:
            self.normaliser.update(self.critic_inputs(rollout))
        self.steps += rollout.numel()
        self.stored += rollout.numel()
        self._extend(self.multi_step, rollout)
        return {}

    def store(self, rollout: TensorDictBase) -> None:
        """Store external transitions, such as those of `op3.train.transitions`, without triggering updates.

        Args:
            rollout: [env, time], with ``done`` at the last step of each.
        """
        padding = rollout[:, -1:].expand(-1, self.settings.n_step)  # after the end, so that all returns are complete
        whole: Any = torch.cat([rollout, padding], 1)
        self._extend(self.returns(), whole)

    def _extend(self, returns: MultiStepTransform, rollout: TensorDictBase) -> None:
        ends = [("next", name) for name in (*self.critic_keys, "reward", "done", "terminated")]
        complete = returns.inv(rollout.select(*self.critic_keys, "action", *ends))
        if complete is not None:
            self.buffer.extend(complete.select(*self.critic_keys, "action", "steps_to_next_obs", *ends).reshape(-1))

    def learn(self) -> Measures:
        """Make the updates that are due for the steps since the last call."""
        due = self._due(self.steps) - self._due(self.learned)
        self.learned, measures = self.steps, {}
        if self.stored >= min(self.settings.warmup, self.settings.buffer):  # false after resuming without a buffer
            for _ in range(due):
                measures = self.update(self.buffer.sample())
                self.count_update()
        return measures

    @property
    def actor_is_due(self) -> bool:
        """Whether this update includes the policy."""
        return self.updates >= self.settings.actor_after and self.updates % self.settings.actor_every == 0

    def update(self, batch: TensorDictBase) -> Measures:
        """One gradient step.

        Args:
            batch: transitions with n-step returns, normalised.

        Returns:
            Measures as scalars on the device.
        """
        losses = self.loss(batch)
        names = [str(name) for name in losses.sorted_keys if str(name).startswith("loss_")]
        critics = [name for name in names if "value" in name]
        optimiser = self.optimisers["loss"]
        optimiser.zero_grad()
        sum(losses[name] for name in (names if self.actor_is_due else critics)).backward()
        optimiser.step()
        self.targets.step()
        return {name.removeprefix("loss_") + "_loss": losses[name].detach() for name in names}

    def get_extra_state(self) -> dict[str, Any]:
        """Counters and, with `checkpoint_buffer`, the buffer."""
        state = super().get_extra_state() | {"steps": self.steps, "learned": self.learned}
        if self.settings.checkpoint_buffer and len(self.buffer):
            data = self.buffer.storage[:].flatten_keys(".")
            if len(self.buffer) < self.settings.buffer:  # saving a view would save the whole underlying tensor
                data = data.clone()
            state |= {"buffer": data.to_dict(), "writer": self.buffer.writer.state_dict()}
        return state

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """The inverse of `get_extra_state`."""
        super().set_extra_state(state)
        self.make_buffer()
        self.steps, self.learned = state["steps"], state["learned"]
        if "buffer" in state:
            data = state["buffer"]
            size = len(data["action"])
            if size > self.settings.buffer:
                raise ValueError(
                    f"the stored buffer has {size} transitions, more than this run's buffer of {self.settings.buffer}"
                )
            self.buffer.extend(TensorDict(data, [size]).unflatten_keys("."))
            self.buffer.writer.load_state_dict(state["writer"])
            self.stored = self.steps

    def _due(self, steps: int) -> int:
        """Number of updates after a number of steps."""
        return int(max(steps - self.settings.warmup, 0) * self.settings.updates_per_step)


class IndexSelectStorage(LazyTensorStorage):
    """TorchRL's storage, read with `index_select`, which is several times faster on CPUs than indexing."""

    def get(self, index: Any) -> Any:
        """Transitions by index."""
        if isinstance(index, Tensor) and index.ndim == 1 and index.dtype == torch.int64:
            rows: Any = self._storage
            return rows.apply(lambda values: values.index_select(0, index.to(values.device)), batch_size=index.shape)
        return super().get(index)  # pyright: ignore[reportArgumentType]


class Mirrored(Transform):
    """Replaces a share of every sampled batch by its mirror image in a plane of symmetry.

    Args:
        mirror: images of observations and actions.
        share: share of the batch, its first part.
    """

    def __init__(self, mirror: Mirror, share: float):
        super().__init__()
        self.mirror, self.share = mirror, share

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The batch with its first part mirrored, in place."""
        part = slice(round(self.share * len(tensordict)))
        images = {"observation": self.mirror.observation, "action": self.mirror.action}
        if "privileged" in tensordict:
            images["privileged"] = self.mirror.privileged
        places: Any = (tensordict, tensordict["next"])
        for place in places:
            for name in images.keys() & place.keys():
                place[name][part] = images[name](place[name][part])
        return tensordict
