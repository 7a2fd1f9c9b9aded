"""A batched environment small enough to learn in seconds: an inverted pendulum driven by angle and gain."""

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from op3.policy import ActionMap, Manifest

TIMESTEP = 0.05
LIMIT = 60


class Pendulum(EnvBase):
    """Lean at the angle shown: reward 1 - |angle - wanted| / 0.5; falling beyond 1 rad terminates.

    Torque and inertia are such that theta'' = 4 sin(theta) + 4 p (target - theta) - w: action (target, gain) with
    the target in +-0.8 rad and the gain p in 0..6.
    """

    def __init__(self, count: int):
        super().__init__(batch_size=[count])
        self.observation_spec = Composite(observation=Unbounded((count, 3)), shape=(count,))
        self.action_spec = Bounded(-1.0, 1.0, (count, 2))
        self.reward_spec = Unbounded((count, 1))
        flags = {name: Binary(1, (count, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(**flags, shape=(count,))
        self.generator = torch.Generator()
        self.state = torch.zeros(count, 3)
        self.steps = torch.zeros(count, dtype=torch.long)

    def _set_seed(self, seed: int | None) -> None:
        self.generator.manual_seed(seed or 0)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        rows = torch.ones(self.batch_size, dtype=torch.bool)
        if tensordict is not None and "_reset" in tensordict.keys():  # noqa: SIM118
            rows = tensordict["_reset"].view(-1)
        fresh = torch.rand(*self.batch_size, 3, generator=self.generator) - 0.5
        fresh[:, 1] *= 0.1
        self.state = torch.where(rows[:, None], fresh, self.state)
        self.steps = torch.where(rows, 0, self.steps)
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict(
            {"observation": self.state.clone(), "done": none, "terminated": none.clone(), "truncated": none.clone()},
            self.batch_size,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        target, gain = 0.8 * tensordict["action"][:, 0], 3.0 * (tensordict["action"][:, 1] + 1)
        angle, rate, wanted = self.state.unbind(-1)
        rate = rate + TIMESTEP * (4 * angle.sin() + 4 * gain * (target - angle) - rate)
        angle = angle + TIMESTEP * rate
        self.state = torch.stack([angle, rate, wanted], -1)
        self.steps = self.steps + 1
        terminated, truncated = angle.abs() > 1.0, self.steps >= LIMIT
        return TensorDict(
            {
                "observation": self.state.clone(),
                "reward": (1 - (angle - wanted).abs() / 0.5)[:, None],
                "terminated": terminated[:, None],
                "truncated": (truncated & ~terminated)[:, None],
                "done": (terminated | truncated)[:, None],
            },
            self.batch_size,
        )


MANIFEST = Manifest(
    task="pendulum",
    layout={"angle": 1, "rate": 1, "wanted": 1},
    history=0,
    action_map=ActionMap(("l_knee",), (-0.3,), (1.5,)),
    hidden=(32, 32),
)


def seeded_pendulums(seed: int, count: int = 16) -> Pendulum:
    """Pendulums for a process of their own."""
    pendulums = Pendulum(count)
    pendulums.set_seed(seed)
    return pendulums
