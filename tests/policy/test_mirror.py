"""The robot's mirror image, on kinematics and in simulation."""

import pytest
import torch

from op3.envs import make_env
from op3.policy import ActionMap, Observer, Sensed
from op3.policy.mirror import Mirror
from op3.robot import load_robot
from op3.tasks import find_task
from tests.op3_table import mirror

WALK = find_task("walk")
MIRROR = WALK.mirror(WALK.action_map())


def test_twice_is_nothing():
    """The image of the image is the original, to the last bit."""
    observation, action = torch.randn(7, 256), torch.rand(7, 20)
    assert torch.equal(MIRROR.observation(MIRROR.observation(observation)), observation)
    assert torch.equal(MIRROR.action(MIRROR.action(action)), action)


def test_observations_agree_with_kinematics():
    """What a mirrored robot observes is the image of what the robot observes, its phase half a cycle later."""
    generator = torch.Generator().manual_seed(0)
    q, v = (torch.randn(5, 20, generator=generator).double() * 0.3 for _ in range(2))
    attitude, rates = (torch.randn(5, 3, generator=generator).double() for _ in range(2))
    action, phase = torch.rand(5, 20, generator=generator).double(), torch.rand(5, generator=generator).double()
    asked = torch.randn(5, 3, generator=generator).double()
    terms = {name: {} for name in (*WALK.layout, "command", "joint_position", "joint_velocity")}

    def observe(*values: torch.Tensor) -> torch.Tensor:
        position, velocity, attitude, rates, action, phase, asked = values
        now = Sensed(position, velocity, action, attitude, rates, phase, {"velocity": asked})
        return Observer(terms, load_robot("op3"), 0, now).reset(now)

    example = Sensed(q[:1], v[:1], action[:1], attitude[:1], rates[:1], phase[:1], {"velocity": asked[:1]})
    observer = Observer(terms, load_robot("op3"), 0, example)
    one = Mirror(observer, example, WALK.action_map(), {"velocity": (1.0, -1.0, -1.0)})
    axial = torch.tensor([-1.0, 1.0, -1.0])
    seen = observe(q, v, attitude, rates, action, phase, asked)
    image = observe(
        torch.from_numpy(mirror(q)), torch.from_numpy(mirror(v)), attitude * axial, rates * axial,
        one.action(action), phase + 0.5, asked * torch.tensor([1.0, -1.0, -1.0]),
    )  # fmt: skip
    torch.testing.assert_close(one.observation(seen), image, rtol=0, atol=1e-9)


def test_the_simulated_image_does_the_image():
    """A robot that takes the mirrored actions sees and earns what the other does in the mirror."""
    env = make_env("walk", num_envs=2, seed=0)
    start = env.reset()
    qpos, qvel = env._qpos, env._qvel
    for state, sign in ((qpos, [1, -1, 1, 1, -1, 1, -1]), (qvel, [1, -1, 1, -1, 1, -1])):
        base = len(sign)
        state[1, :base] = state[0, :base] * sign
        state[1, base:] = mirror(state[0, base:])
    env.mdp._first_phase[:] = torch.tensor([0.1, 0.6])
    env.simulation.batch.forward()
    generator = torch.Generator().manual_seed(1)
    stand = torch.from_numpy(ActionMap.around_stand(load_robot("op3")).stand(4.0)).float()
    state = start
    for _ in range(10):
        action = (stand + 0.2 * torch.randn(20, generator=generator)).clamp(-1, 1)
        state["action"] = torch.stack([action, MIRROR.action(action)])
        state = env.step(state)["next"]
        seen, reward = state["observation"], state["reward"]
        state = state.exclude("reward")
    # the links' centres of mass and inertias are symmetric to a millimetre or so, no further
    off, moved = (MIRROR.observation(seen[0]) - seen[1]).norm(), (seen[0] - seen[1]).norm()
    assert off < 0.1 * moved
    torch.testing.assert_close(reward[0], reward[1], rtol=0, atol=0.02)


def knee(sensed: Sensed, side: int) -> torch.Tensor:
    """A term without an image: the left knee alone."""
    return sensed.joint_position[..., side : side + 1]


def lean(sensed: Sensed) -> torch.Tensor:
    """A term of a user with an image: roll, which turns round, and the product of roll and yaw, which does not."""
    assert sensed.orientation is not None
    roll, _, yaw = sensed.orientation.unbind(-1)
    return torch.stack([roll, roll * yaw], -1)


def test_own_terms_have_the_image_that_they_have():
    """The image of a user's term is found; what has none is named."""
    task = WALK.changed({"observations.lean": {"function": f"{__name__}.lean"}, "history": 0})
    image = task.mirror(task.action_map()).observation(torch.arange(task.observation_size) + 1.0)
    assert image[-2:].tolist() == [-(task.observation_size - 1), task.observation_size]
    alone = WALK.changed({"observations.knee": {"function": f"{__name__}.knee", "side": 3}})
    with pytest.raises(ValueError, match="'knee' has no mirror image"):
        alone.mirror(alone.action_map())
    with pytest.raises(ValueError, match="its partner r_knee is not controlled"):
        WALK.mirror(ActionMap.around_stand(load_robot("op3"), joints=("l_knee",)))
