"""Images of what a policy sees and does in the robot's plane of symmetry, y = 0."""

from collections.abc import Mapping

import torch
from torch import Tensor

from op3.policy.actions import ActionMap
from op3.robot import load_robot


class Mirror:
    """Observations and actions of the robot's mirror image: the OP3 and its tasks are symmetric.

    The image of a walk is half a cycle later, because the feet change their parts. Mirroring twice changes nothing.

    Args:
        layout: name and size of each part of one observation, see `op3.policy.observation`.
        history: how many earlier observations follow the latest.
        action_map: what actions mean, and of which robot.

    Raises:
        ValueError: if the robot has no plane of symmetry, a part of the observation has no known image, or a joint's
            partner is not controlled.
    """

    def __init__(self, layout: Mapping[str, int], history: int, action_map: ActionMap):
        robot, joints = load_robot(action_map.robot), action_map.joints
        images = robot.mirror
        if alone := [name for name in joints if images[name][0] not in joints]:
            raise ValueError(f"{alone[0]} has no image: its partner {images[alone[0]][0]} is not controlled")
        partner = [joints.index(images[name][0]) for name in joints]
        sign = [float(images[name][1]) for name in joints]
        size = len(joints)
        gains = action_map.size - size
        self._action = torch.tensor([*partner, *(size + i for i in partner[:gains])])
        self._action_sign = torch.tensor([*sign, *[1.0] * gains])
        feet = [leg[-1] for leg in robot.legs]
        each = max(len(robot.file.key_points), len(feet)) // max(len(feet), 1)
        # a point of a foot becomes the same point of the foot on the other side
        points = [each * feet.index(images[foot][0]) + point for foot in feet for point in range(each)]
        coordinates = torch.tensor([3 * point + axis for point in points for axis in range(3)])
        every = robot.joints
        whole = (
            torch.tensor([every.index(images[name][0]) for name in every]),
            torch.tensor([float(images[name][1]) for name in every]),
        )
        # a rotation is an axial vector: the reflection keeps its part along y and reverses the others
        axial = torch.tensor([-1.0, 1.0, -1.0])
        seen = {
            "key_point_position": (coordinates, torch.tensor([1.0, -1.0, 1.0] * len(points))),
            "key_point_velocity": (coordinates, torch.tensor([1.0, -1.0, 1.0] * len(points))),
            "previous_action": (self._action, self._action_sign),
            "orientation": tuple(part[: layout.get("orientation", 3)] for part in (torch.arange(3), axial)),
            "angular_velocity": (torch.arange(3), axial),
            "phase": (torch.arange(2), torch.tensor([-1.0, -1.0])),
            "heading_error": (torch.arange(1), torch.tensor([-1.0])),
            "command": (torch.arange(3), torch.tensor([1.0, -1.0, -1.0])),
            "joint_position": whole,
            "joint_velocity": whole,
        }
        index, signs, first = [], [], 0
        for name, size in layout.items():
            if name not in seen or len(seen[name][0]) != size:
                raise ValueError(f"the observation's part {name!r} of {size} numbers has no known mirror image")
            index.append(first + seen[name][0])
            signs.append(seen[name][1])
            first += size
        frame = torch.cat(index)
        self._observation = torch.cat([frame + first * k for k in range(history + 1)])
        self._observation_sign = torch.cat(signs).repeat(history + 1)

    def observation(self, observation: Tensor) -> Tensor:
        """The image's observation ``[..., observation]``, history included."""
        return observation[..., self._observation] * self._observation_sign.to(observation)

    def action(self, action: Tensor) -> Tensor:
        """The image's action ``[..., action]``."""
        return action[..., self._action] * self._action_sign.to(action)
