"""Description of a policy without its weights: observation, action map, rates and origin."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field

from op3.common.settings import Count, Named, Positive, Some, Whole, parse_yaml, settings
from op3.policy.actions import ActionMap
from op3.robot import Robot, load_robot

FORMAT = "op3-policy/1"

COMMAND_RATE = 125.0
"""Rate of the PD control [Hz] (paper Sec. robot setup)."""

POLICY_RATE = 31.25
"""Rate of the policy [Hz] (paper Sec. robot setup): every fourth tick of the PD control."""


@settings("policy manifest: training")
class Training:
    """Origin of a policy.

    Attributes:
        model: name or file of the robot model it was trained on.
        model_hash: hash of that model.
        git_hash: commit of the code.
        seed: seed of the run.
        steps: environment steps.
        updates: gradient steps.
        command: command that trained the policy.
        date: ISO 8601.
        settings: settings of the algorithm, plain values.
    """

    model: str = ""
    model_hash: str = ""
    git_hash: str = ""
    seed: Whole = 0
    steps: Whole = 0
    updates: Whole = 0
    command: str = ""
    date: str = ""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)


@settings("policy manifest")
class Manifest:
    """Observations and actions of a policy.

    Attributes:
        task: task that it was trained for, such as `balance` or `walk`.
        layout: name and size of each part of one observation, in order.
        history: number of earlier observations that are appended to the latest, n in the paper.
        observations: terms of one observation by name, see `op3.policy.observation`; none in files of older versions,
            whose parts are terms of their own name.
        cycle: duration of a gait cycle [s]; None for a policy that does not observe the phase.
        action_map: map from actions to commands.
        hidden: units of the hidden layers.
        activation: activation function of the hidden layers.
        command_rate: rate of the PD control [Hz].
        policy_rate: rate of the policy [Hz].
        normalisation: `fixed` or `running`: how mean and scale of the observation were determined.
        clip: bound of a normalised observation.
        training: origin.
    """

    task: str
    layout: Annotated[Named[Count], Field(min_length=1)]
    history: Whole
    action_map: ActionMap
    hidden: Some[Count]
    activation: Literal["relu", "elu", "silu", "tanh"] = "relu"
    command_rate: Positive = COMMAND_RATE
    policy_rate: Positive = POLICY_RATE
    normalisation: Literal["fixed", "running"] = "fixed"
    clip: Positive = 10.0
    observations: Named[Any] = dataclasses.field(default_factory=dict, hash=False)
    cycle: Positive | None = None
    training: Training = dataclasses.field(default_factory=Training)

    def __post_init__(self):
        terms = {name: dict(self.observations.get(name) or {}) for name in self.layout}
        object.__setattr__(self, "observations", terms)
        ratio = self.command_rate / self.policy_rate
        if ratio < 1 or abs(ratio - round(ratio)) > 1e-9:
            raise ValueError(
                f"policy manifest: policy_rate {self.policy_rate} Hz does not divide {self.command_rate} Hz"
            )

    @property
    def observation_size(self) -> int:
        """Numbers in an observation: the latest one and `history` earlier ones."""
        return sum(self.layout.values()) * (self.history + 1)

    def check_fits(self, layout: Mapping[str, int], history: int, command_rate: float, policy_rate: float) -> None:
        """Raise an error for a robot or task whose observations or rates differ from the policy's training.

        Args:
            layout: name and size of each part of one observation, in order.
            history: number of earlier observations besides the latest.
            command_rate: rate of the PD control [Hz].
            policy_rate: rate of the policy [Hz].

        Raises:
            ValueError: names the differing field, both values and the task of the training.
        """

        def said(layout: Mapping[str, int]) -> str:
            return ", ".join(f"{part} {size}" for part, size in layout.items())

        fields = {
            "layout": (said(self.layout), said(layout)),
            "history": (f"{self.history}", f"{history}"),
            "command_rate": (f"{self.command_rate:g} Hz", f"{command_rate:g} Hz"),
            "policy_rate": (f"{self.policy_rate:g} Hz", f"{policy_rate:g} Hz"),
        }
        for name, (made, here) in fields.items():
            if made != here:
                raise ValueError(
                    f"field {name} of its manifest is {made}, expected {here}; the policy was trained for {self.task}: "
                    "choose that task, or another policy"
                )

    def check_robot(self, robot: str | Robot) -> None:
        """Raise a ValueError that names both robots if the policy was trained for another robot."""
        made, here = load_robot(self.action_map.robot).name, load_robot(robot).name
        if made != here:
            raise ValueError(
                f"the policy was trained for the robot {made}, but this one is {here}; use a policy for {here}"
            )

    def to_yaml(self) -> str:
        """The text of ``manifest.yaml``."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        values["layout"], values["observations"] = dict(self.layout), dict(self.observations)
        values["hidden"] = list(self.hidden)
        values["action_map"] = self.action_map.to_dict()
        values["training"] = dataclasses.asdict(self.training)
        head = {"format": FORMAT, "observation_size": self.observation_size}
        return yaml.safe_dump({**head, **values}, sort_keys=False, default_flow_style=None, width=120)

    @classmethod
    def from_yaml(cls, text: str) -> "Manifest":
        """The inverse of `to_yaml`.

        Raises:
            ValueError: if a field is missing, unknown or impossible; the message names it.
        """
        values = parse_yaml(text, "policy manifest")
        if values.pop("format", None) != FORMAT:
            raise ValueError(f"policy manifest: format must be {FORMAT!r}; this is not a manifest of this version")
        size = values.pop("observation_size", None)
        for name, kind in (("action_map", ActionMap.from_dict), ("training", lambda given: Training(**given))):
            if isinstance(values.get(name), Mapping):
                values[name] = kind(values[name])
        manifest = cls(**values)
        if size is not None and size != manifest.observation_size:
            raise ValueError(
                f"policy manifest: observation_size is {size}, but layout and history give {manifest.observation_size}"
            )
        return manifest
