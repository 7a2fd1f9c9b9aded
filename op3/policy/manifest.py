"""What a policy's weights do not say: observation, action map, rates, and where the policy comes from."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import yaml

from op3.policy.actions import ActionMap

FORMAT = "op3-policy/1"

COMMAND_RATE = 125.0
"""Rate of the PD control [Hz] (paper Sec. robot setup)."""

POLICY_RATE = 31.25
"""Rate of the policy [Hz] (paper Sec. robot setup): every fourth tick of the PD control."""


@dataclasses.dataclass(frozen=True)
class Training:
    """Where a policy comes from.

    Attributes:
        model: name or file of the robot model it was trained on.
        model_hash: hash of that model.
        git_hash: commit of the code.
        seed: of the run.
        steps: environment steps.
        updates: gradient steps.
        command: that made it.
        date: ISO 8601.
        settings: of the algorithm, plain values.
    """

    model: str = ""
    model_hash: str = ""
    git_hash: str = ""
    seed: int = 0
    steps: int = 0
    updates: int = 0
    command: str = ""
    date: str = ""
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict, hash=False)


@dataclasses.dataclass(frozen=True)
class Manifest:
    """What a policy reads and commands.

    Attributes:
        task: it was trained for, `balance` or `walk`.
        layout: name and size of each part of one observation, in order.
        history: how many earlier observations are appended to the latest, n in the paper.
        action_map: what its actions mean.
        hidden: units of the hidden layers, ReLU each.
        command_rate: of the PD control [Hz].
        policy_rate: of the policy [Hz].
        normalisation: `fixed` or `running`, how mean and scale of the observation were found.
        clip: bound of a normalised observation.
        training: where it comes from.
    """

    task: str
    layout: Mapping[str, int]
    history: int
    action_map: ActionMap
    hidden: tuple[int, ...]
    command_rate: float = COMMAND_RATE
    policy_rate: float = POLICY_RATE
    normalisation: str = "fixed"
    clip: float = 10.0
    training: Training = dataclasses.field(default_factory=Training)

    def __post_init__(self):
        object.__setattr__(self, "hidden", tuple(self.hidden))
        object.__setattr__(self, "layout", dict(self.layout))
        if not self.layout or not all(_whole(size, 1) for size in self.layout.values()):
            raise ValueError(f"field layout: needs parts with whole sizes of at least 1, got {dict(self.layout)}")
        if not _whole(self.history, 0):
            raise ValueError(f"field history: must be a whole number of at least 0, got {self.history!r}")
        if not self.hidden or not all(_whole(units, 1) for units in self.hidden):
            raise ValueError(f"field hidden: needs whole numbers of units of at least 1, got {list(self.hidden)}")
        if not isinstance(self.action_map, ActionMap):
            raise ValueError(f"field action_map: must be an action map, got {type(self.action_map).__name__}")
        for name in ("command_rate", "policy_rate", "clip"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
                raise ValueError(f"field {name}: must be a positive number, got {value!r}")
        ratio = self.command_rate / self.policy_rate
        if ratio < 1 or abs(ratio - round(ratio)) > 1e-9:
            raise ValueError(
                f"field policy_rate: {self.policy_rate} Hz does not divide the command rate {self.command_rate} Hz"
            )
        if self.normalisation not in ("fixed", "running"):
            raise ValueError(f"field normalisation: must be fixed or running, got {self.normalisation!r}")

    @property
    def observation_size(self) -> int:
        """Numbers in an observation: the latest one and `history` earlier ones."""
        return sum(self.layout.values()) * (self.history + 1)

    @property
    def command_ticks(self) -> int:
        """Ticks of the PD control per action."""
        return round(self.command_rate / self.policy_rate)

    def to_yaml(self) -> str:
        """The text of ``manifest.yaml``."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        values["layout"] = dict(self.layout)
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
        try:
            values = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError) as error:
            raise ValueError(f"not valid YAML ({' '.join(str(error).split())})") from None
        if not isinstance(values, dict) or values.pop("format", None) != FORMAT:
            raise ValueError(f"field format must be {FORMAT!r}; this is no policy manifest of this version")
        size = values.pop("observation_size", None)
        known = {field.name for field in dataclasses.fields(cls)}
        if missing := sorted(known - set(values)):
            raise ValueError(f"field {missing[0]} is missing")
        if unknown := sorted(map(str, set(values) - known)):
            raise ValueError(f"unknown field {unknown[0]}; remove it")
        values["action_map"] = ActionMap.from_dict(values["action_map"])
        values["training"] = _training(values["training"])
        for name, kind in (("layout", dict), ("hidden", list)):
            if not isinstance(values[name], kind):
                raise ValueError(f"field {name}: must be a {kind.__name__}, got {values[name]!r}")
        manifest = cls(**values)
        if size is not None and size != manifest.observation_size:
            raise ValueError(
                f"field observation_size: {size} is not the {manifest.observation_size} that layout and history give"
            )
        return manifest


def _whole(value: Any, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _training(values: Any) -> Training:
    known = {field.name for field in dataclasses.fields(Training)}
    if not isinstance(values, Mapping) or not set(values) <= known:
        raise ValueError(f"field training: may hold {', '.join(sorted(known))} only")
    return Training(**values)
