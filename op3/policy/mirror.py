"""Mirror images of observations and actions in the robot's plane of symmetry, y = 0."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from op3.policy.actions import ActionMap
from op3.policy.observation import Observer
from op3.policy.observations import Sensed
from op3.robot import load_robot

AXIAL = (-1.0, 1.0, -1.0)
"""Signs of the mirror image of an axial vector, such as a rotation: x and z change sign, y does not."""

SAMPLES = 64
"""Random states from which the mirror image of an observation is derived."""

LEAST_LIKENESS = 0.99
"""Smallest cosine between the samples of a mirrored number and its partner. Unrelated numbers have about 0; left and
right of a CAD model differ by about a millimetre."""


class Mirror:
    """Observations and actions of the robot's mirror image; robot and task are assumed to be symmetric.

    The image of a walk is half a cycle later, because the feet swap roles. The mirror images of a robot's joints, IMU,
    commands and gait are known. The mirror images of observations are derived from these: terms are evaluated in random
    states and in their images, and each number of an image must equal plus or minus one number of the original.

    Args:
        observer: observer of the policy.
        example: sensor readings of one robot, ``[1, ...]``.
        action_map: action map of the robot.
        commands: signs of the image of each command, by name.
        privileged: signs of the image of each privileged number.

    Raises:
        ValueError: if the robot has no plane of symmetry, a joint's partner is not controlled, or a command or an
            observation has no mirror image.
    """

    def __init__(
        self,
        observer: Observer,
        example: Sensed,
        action_map: ActionMap,
        commands: Mapping[str, Sequence[float] | None],
        privileged: Sequence[float] = (),
    ):
        robot, joints = load_robot(action_map.robot), action_map.joints
        images = robot.mirror
        if alone := [name for name in joints if images[name][0] not in joints]:
            raise ValueError(f"{alone[0]} has no mirror image: its partner {images[alone[0]][0]} is not controlled")
        if alone := [name for name, signs in commands.items() if signs is None]:
            raise ValueError(f"the command {alone[0]} has no known mirror image: add mirror = (<signs>) to its class")
        partner = [joints.index(images[name][0]) for name in joints]
        gains = action_map.size - len(joints)
        self._action = torch.tensor([*partner, *(len(joints) + i for i in partner[:gains])])
        self._action_sign = torch.tensor([*(float(images[name][1]) for name in joints), *[1.0] * gains])
        known = {
            name: torch.tensor(signs, dtype=torch.float64) for name, signs in commands.items() if signs is not None
        }
        seen = _random(example)
        image = self._image(seen, robot.mirror, robot.joints, known)
        index, signs, first = [], [], 0
        for term in observer.terms:
            found = _signed_permutation(term(seen).numpy(), term(image).numpy())
            if found is None:
                raise ValueError(f"the observation {term.name!r} has no mirror image")
            index.append(first + found[0])
            signs.append(found[1])
            first += observer.layout[term.name]
        frame = torch.cat(index)
        self._observation = torch.cat([frame + first * k for k in range(observer.history + 1)])
        self._observation_sign = torch.cat(signs).repeat(observer.history + 1)
        self._privileged_sign = torch.tensor(privileged)

    def observation(self, observation: Tensor) -> Tensor:
        """The image's observation ``[..., observation]``, history included."""
        return observation.index_select(-1, self._observation.to(observation.device)) * self._observation_sign.to(
            observation
        )

    def privileged(self, privileged: Tensor) -> Tensor:
        """The image's privileged observation, ``[..., number]``."""
        return privileged * self._privileged_sign.to(privileged)

    def action(self, action: Tensor) -> Tensor:
        """The image's action ``[..., action]``."""
        return action.index_select(-1, self._action.to(action.device)) * self._action_sign.to(action)

    def _image(
        self, seen: Sensed, images: Mapping[str, tuple[str, int]], joints: Sequence[str], commands: Mapping[str, Tensor]
    ) -> Sensed:
        """Sensor readings of the mirror images of robots."""
        partner = [joints.index(images[name][0]) for name in joints]
        sign = torch.tensor([float(images[name][1]) for name in joints], dtype=torch.float64)
        axial = torch.tensor(AXIAL, dtype=torch.float64)
        return Sensed(
            joint_position=seen.joint_position[:, partner] * sign,
            joint_velocity=seen.joint_velocity[:, partner] * sign,
            previous_action=self.action(seen.previous_action),
            orientation=None if seen.orientation is None else seen.orientation * axial,
            angular_velocity=None if seen.angular_velocity is None else seen.angular_velocity * axial,
            phase=None if seen.phase is None else torch.remainder(seen.phase + 0.5, 1.0),
            commands={name: value * commands[name] for name, value in seen.commands.items()},
        )


def _random(example: Sensed) -> Sensed:
    """Random states around that of an example."""
    generator = torch.Generator().manual_seed(0)

    def scattered(values: Tensor | None, size: float = 0.3) -> Tensor | None:
        if values is None:
            return None
        noise = torch.randn(SAMPLES, *values.shape[1:], generator=generator, dtype=torch.float64)
        return values.to(torch.float64) + size * noise

    names = [f.name for f in dataclasses.fields(Sensed) if f.init and f.name != "commands"]
    values = {name: scattered(getattr(example, name)) for name in names}
    commands = {name: scattered(value) for name, value in example.commands.items()}
    return Sensed(**values, commands=commands)  # type: ignore[arg-type]


def _signed_permutation(original: np.ndarray, image: np.ndarray) -> tuple[Tensor, Tensor] | None:
    """Index and sign of the matching original number for each number of the image; None without a match.

    Args:
        original: samples, ``[sample, number]``.
        image: mirror images of these samples, ``[sample, number]``.
    """
    size = np.linalg.norm(original, axis=0), np.linalg.norm(image, axis=0)
    likeness = (image.T @ original) / np.maximum(np.outer(size[1], size[0]), 1e-12)
    still = size[1] < 1e-9  # numbers that are always 0 are their own images
    likeness[still, still] = 1.0
    # if several numbers are equal, the number itself takes precedence
    nearest = np.argmax(np.abs(likeness) + 1e-6 * np.eye(len(likeness)), axis=1)
    rows = np.arange(len(nearest))
    sign = np.sign(likeness[rows, nearest])
    off = np.linalg.norm(image - sign * original[:, nearest], axis=0)
    alike = (np.abs(likeness[rows, nearest]) >= LEAST_LIKENESS) & (
        off <= 2 * np.sqrt(1 - LEAST_LIKENESS) * size[1] + 1e-9
    )
    if not alike.all():
        return None
    return torch.from_numpy(nearest), torch.from_numpy(sign).float()
