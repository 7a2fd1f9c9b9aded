"""A policy as a folder: ``policy.pt`` with the weights and ``manifest.yaml`` with the rest."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch.nn import functional

from op3.common.assets import here_or_shipped
from op3.common.writing import write_folder
from op3.policy.actions import Array
from op3.policy.manifest import Manifest

WEIGHTS = "policy.pt"
MANIFEST = "manifest.yaml"


def weight_shapes(manifest: Manifest) -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor of a policy: normalisation of the observation, then the layers."""
    sizes = (manifest.observation_size, *manifest.hidden, manifest.action_map.size)
    shapes: dict[str, tuple[int, ...]] = {"observation.mean": (sizes[0],), "observation.scale": (sizes[0],)}
    for number, (inputs, outputs) in enumerate(pairwise(sizes)):
        shapes |= {f"layer_{number}.weight": (outputs, inputs), f"layer_{number}.bias": (outputs,)}
    return shapes


class PolicyBundle:
    """A trained policy: a = tanh(mean(observation)), without exploration.

    Args:
        weights: tensors by the names and shapes of `weight_shapes`; ``observation.mean`` and
            ``observation.scale`` normalise as clip((observation - mean) / scale).

    Raises:
        ValueError: if a tensor is missing, unknown, of another shape or not finite, or a scale is not positive.
    """

    def __init__(self, manifest: Manifest, weights: Mapping[str, torch.Tensor]):
        self.manifest = manifest
        self.weights = _checked(manifest, weights)
        self._mean, self._scale = self.weights["observation.mean"], self.weights["observation.scale"]
        count = len(manifest.hidden) + 1
        self._layers = [
            (self.weights[f"layer_{i}.weight"].t().contiguous(), self.weights[f"layer_{i}.bias"]) for i in range(count)
        ]

    @torch.inference_mode()
    def act(self, observation: Array) -> Array:
        """Deterministic actions.

        Args:
            observation: [..., observation], numpy or torch.

        Returns:
            [..., 2 joint] in [-1, 1], of the type and precision of the input.

        Raises:
            ValueError: if the observation has another size or is not finite.
        """
        given = torch.as_tensor(observation)
        if not given.ndim or given.shape[-1] != self.manifest.observation_size:
            raise ValueError(
                f"the policy needs observations of {self.manifest.observation_size} numbers, "
                f"got an array of shape {tuple(given.shape)}"
            )
        values = (given.to(torch.float32) - self._mean) / self._scale
        if not bool(torch.isfinite(values).all()):
            raise ValueError("an observation is not finite; stop the robot and check its sensors")
        values = values.clamp(-self.manifest.clip, self.manifest.clip)
        activation = getattr(functional, self.manifest.activation)
        for weight, bias in self._layers[:-1]:
            values = activation(values @ weight + bias)
        weight, bias = self._layers[-1]
        action: Any = torch.tanh(values @ weight + bias).to(given.dtype)
        return action if isinstance(observation, torch.Tensor) else action.numpy()

    @property
    def fingerprint(self) -> str:
        """Hash of the policy's function, 16 hexadecimal digits, from weights and manifest without their origin.

        Fields at their defaults are ignored, so that fields of later versions do not change the hash.
        """
        fields = [f for f in dataclasses.fields(self.manifest) if f.name != "training"]
        values = {f.name: getattr(self.manifest, f.name) for f in fields}
        changed = {
            f.name: values[f.name] for f in fields if f.default is dataclasses.MISSING or values[f.name] != f.default
        }
        digest = hashlib.sha256(json.dumps(changed, default=dataclasses.asdict, sort_keys=True).encode())
        for name in sorted(self.weights):
            digest.update(name.encode() + self.weights[name].contiguous().numpy().tobytes())
        return digest.hexdigest()[:16]

    def save(self, folder: str | Path, overwrite: bool = False) -> Path:
        """Write the bundle atomically.

        Args:
            overwrite: whether to replace an existing bundle.
        """
        folder = Path(folder)

        def fill(temporary: Path) -> None:
            torch.save(dict(self.weights), temporary / WEIGHTS)
            (temporary / MANIFEST).write_text(self.manifest.to_yaml(), encoding="utf-8")

        write_folder(folder, fill, overwrite=overwrite)
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> "PolicyBundle":
        """Read a bundle; nothing in the file is executed.

        Raises:
            FileNotFoundError: if a file is missing.
            ValueError: if the bundle is invalid; the message names file, field and remedy.
        """
        folder = here_or_shipped(folder)
        if not (folder / MANIFEST).exists() and (folder / "policy" / MANIFEST).is_file():  # a training run
            folder = folder / "policy"
        for name in (MANIFEST, WEIGHTS):
            if not (folder / name).is_file():
                raise FileNotFoundError(
                    f"{folder}: no {name} there; give the folder of a policy bundle (`policy` in a training run)"
                )
        try:
            manifest = Manifest.from_yaml((folder / MANIFEST).read_text(encoding="utf-8"))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{folder / MANIFEST}: {error}; restore the bundle or train again") from None
        try:
            weights = torch.load(folder / WEIGHTS, map_location="cpu", weights_only=True)
        except Exception as error:  # torch's reader raises many kinds of errors on foreign files
            reason = " ".join(str(error).split())[:80]
            raise ValueError(f"{folder / WEIGHTS}: not a valid weights file ({reason}); restore the bundle") from None
        try:
            return cls(manifest, weights)
        except ValueError as error:
            raise ValueError(f"{folder / WEIGHTS}: {error}; restore the bundle or train again") from None


def _checked(manifest: Manifest, weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    shapes = weight_shapes(manifest)
    if not isinstance(weights, Mapping):
        raise ValueError(f"the weights are a {type(weights).__name__}, not a mapping of tensors")
    if missing := [name for name in shapes if name not in weights]:
        raise ValueError(f"tensor {missing[0]} is missing")
    if unknown := [name for name in weights if name not in shapes]:
        raise ValueError(f"there is an unknown tensor {unknown[0]}")
    checked = {}
    for name, shape in shapes.items():
        tensor = weights[name]
        if not isinstance(tensor, torch.Tensor) or not tensor.is_floating_point() or tuple(tensor.shape) != shape:
            given = tuple(tensor.shape) if isinstance(tensor, torch.Tensor) else type(tensor).__name__
            raise ValueError(f"tensor {name} is {given}, but the manifest requires floats of shape {shape}")
        checked[name] = tensor.detach().to("cpu", torch.float32, copy=True)
        if not bool(torch.isfinite(checked[name]).all()):
            raise ValueError(f"tensor {name} contains non-finite values")
    if bool((checked["observation.scale"] <= 0).any()):
        raise ValueError("tensor observation.scale contains non-positive values")
    return checked
