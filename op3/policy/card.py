"""The measured behaviour of a policy in simulation, ``card.yaml`` in its bundle; its first line is WALKS, STANDS or
FALLS.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import yaml

from op3.common.assets import here_or_shipped
from op3.common.settings import Count, Named, NotNegative, Share, settings
from op3.common.writing import write_text
from op3.policy.bundle import PolicyBundle
from op3.robot.self_collision import LARGEST_OVERLAP

CARD = "card.yaml"
FORMAT = "op3-card/1"

LARGEST_SELF_CONTACT = 0.02
"""Largest share of steps with self-contact for a policy that may run on a robot [-]: one misstep of 0.2 s in ten
seconds of walking. If one leg leans on the other, it touches in every step of the gait.
"""


@settings("policy card")
class Card:
    """Results of `op3 evaluate`; units are SI, shares are between 0 and 1.

    Attributes:
        verdict: whether at least nine of ten robots walk, or stand, to the end of their episode.
        policy: fingerprint of the policy, see `PolicyBundle.fingerprint`.
        task: task of the episodes.
        model: name or file of the robot model.
        robots: number of robots in each row of `robustness`.
        self_contact: share of physics steps in which the robot touches itself.
        penetration: depth of the deepest self-contact [m].
        validity: further numbers of the gait, see `op3.envs.gait_validity.GaitValidity`.
        robustness: success by variation, with its 95 % interval.
        pushes: largest impulse survived at the trunk [N s], mean and by direction, with 95 % intervals.
        commands: tracking errors of a walk with commands, see `op3.envs.tracking.Obedience`; empty for others.
        cost: currents [A], power [W] and cost of transport.
        made: command, commit and date.
    """

    verdict: Literal["WALKS", "STANDS", "FALLS"]
    policy: str
    task: str
    model: str
    robots: Count
    self_contact: Share
    penetration: NotNegative
    validity: Named[Any] = dataclasses.field(default_factory=dict)
    robustness: Named[Any] = dataclasses.field(default_factory=dict)
    pushes: Named[Any] = dataclasses.field(default_factory=dict)
    commands: Named[Any] = dataclasses.field(default_factory=dict)
    cost: Named[Any] = dataclasses.field(default_factory=dict)
    made: Named[Any] = dataclasses.field(default_factory=dict)

    def refusal(self, bundle: PolicyBundle) -> str | None:
        """The reason why a robot must not run the policy, as text that follows its name; None if it may."""
        if self.policy != bundle.fingerprint:
            return f"has the card of another policy ({self.policy} instead of {bundle.fingerprint})"
        if self.verdict == "FALLS":
            return "falls in simulation according to its card"
        if self.self_contact > LARGEST_SELF_CONTACT:
            return (
                f"touches itself in {100 * self.self_contact:.1f} % of the steps in simulation;"
                f" {100 * LARGEST_SELF_CONTACT:g} % are allowed"
            )
        if self.penetration > LARGEST_OVERLAP:
            return (
                f"overlaps itself by {1000 * self.penetration:.1f} mm in simulation;"
                f" {1000 * LARGEST_OVERLAP:g} mm are allowed"
            )
        return None

    def to_yaml(self) -> str:
        """The text of ``card.yaml``: the verdict, then everything else as a second document."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        del values["verdict"]
        body = yaml.safe_dump({"format": FORMAT, **values}, sort_keys=False, default_flow_style=None, width=120)
        return f"{self.verdict}\n---\n{body}"

    @classmethod
    def from_yaml(cls, text: str) -> Card:
        """The inverse of `to_yaml`.

        Raises:
            ValueError: if a field is missing, unknown or impossible; the message names it.
        """
        try:
            documents = list(yaml.safe_load_all(text))
        except yaml.YAMLError as error:
            raise ValueError(f"policy card: invalid YAML ({' '.join(str(error).split())})") from None
        if len(documents) != 2 or not isinstance(documents[1], dict):
            raise ValueError("policy card: it must have a line WALKS, STANDS or FALLS, a line ---, and the fields")
        verdict, fields = documents
        if fields.pop("format", None) != FORMAT:
            raise ValueError(f"policy card: format must be {FORMAT!r}")
        return cls(verdict=verdict, **fields)

    def save(self, folder: str | Path) -> Path:
        """Write the card into a bundle's folder atomically."""
        path = Path(folder) / CARD
        write_text(path, self.to_yaml())
        return path


def find_card(folder: str | Path) -> Card | None:
    """The card of a bundle; None if it has none.

    Raises:
        ValueError: if the file is invalid; the message names file, field and remedy.
    """
    path = here_or_shipped(folder) / CARD
    if not path.is_file():
        return None
    try:
        return Card.from_yaml(path.read_text(encoding="utf-8"))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}; write it again with op3 evaluate policy={folder} card=true") from None


def check_card(folder: str | Path, bundle: PolicyBundle) -> Card:
    """The card of a bundle that a robot may run.

    Raises:
        ValueError: if it has no card, or the card does not allow it.
    """
    card = find_card(folder)
    command = f"op3 evaluate policy={folder} task={bundle.manifest.task} card=true"
    if card is None:
        raise ValueError(f"{folder} has no card ({CARD}), so its behaviour is untested: write one with {command}")
    if why := card.refusal(bundle):
        raise ValueError(f"{folder} {why}: train another policy, or evaluate this one again with {command}")
    return card
