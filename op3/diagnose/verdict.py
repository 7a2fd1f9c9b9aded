"""A verdict: findings, what stays unexplained in every joint, and how far its base can be trusted."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from op3.servo import RobotModel, effect_class

LIKELY = 0.5
"""Probability beyond which a finding is a name; at most that of findings on a base in doubt."""


@dataclass(frozen=True)
class Rival:
    """A name that the logs hardly tell from a finding's."""

    effect: str
    joints: tuple[str, ...]
    shared: bool
    probability: float


@dataclass(frozen=True)
class Finding:
    """One effect that the model lacks, or a number of its chain of measurement that is unusual.

    Attributes:
        effect: name in the catalogue.
        joints: names of the joints in which it sits.
        shared: whether all joints have it alike.
        parameter: the number that says how much of it there is.
        size: its value; of an effect that the base has, what is added to that.
        unit: of the size.
        interval: 90 % interval of the size.
        probability: that this is what is missing.
        log_odds: of the evidence behind it.
        alternatives: what it could be confused with, with probabilities.
        explains: share of the squared torques that the base lacks.
        torque: what it makes in the joints that feel it most [N m], root mean square.
        of_base: whether it is a number that every base has, far from what is usual, and so in every model.
        in_model: whether the model handed back has it.
    """

    effect: str
    joints: tuple[str, ...]
    shared: bool
    parameter: str
    size: float
    unit: str
    interval: tuple[float, float]
    probability: float
    log_odds: float
    alternatives: tuple[Rival, ...] = ()
    explains: float = 0.0
    torque: Mapping[str, float] = field(default_factory=dict)
    of_base: bool = False
    in_model: bool = True

    @property
    def separate_by(self) -> str:
        """The experiments that would tell it from its rivals."""
        names = [self.effect, *(rival.effect for rival in self.alternatives)] if self.alternatives else []
        return separating(names)

    @property
    def likely(self) -> bool:
        """Whether it, or one of its rivals, is more likely there than not."""
        return self.probability + sum(rival.probability for rival in self.alternatives) > LIKELY

    @property
    def phrase(self) -> str:
        """Name, place and size in a few words."""
        size = f"{self.size:.3g} {self.unit}".removesuffix(" -")  # pure numbers have no unit
        return f"{_place(self.effect, self.joints, self.shared)} ({self.parameter} {size})"


@dataclass(frozen=True)
class JointGap:
    """What a joint lacks, in torque, root mean square over windows [N m].

    Attributes:
        before: under the base.
        after: with the findings.
        floor: what sensors make of noise.
        unexplained: what the joint does and no effect of the catalogue explains.
        flagged: whether that is more than joints of sound robots have.
        shape: share of it that goes with position, velocity, load and time.
    """

    before: float
    after: float
    floor: float
    unexplained: float
    flagged: bool
    shape: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a diagnosis says.

    Attributes:
        findings: most probable first.
        joints: what each joint lacks, by name.
        doubts: sentences about the base: numbers at a bound, other optima.
        untold: shared numbers that the logs do not tell.
        cannot_tell: what the logs do not show, and what to record.
        base: the refitted base model.
        model: the model handed back.
        choice: by number of findings, what its model leaves of withheld runs, and which was taken.
        gap: by channel, before and after on runs that nothing was chosen by.
        loss: ``paper_eq7`` before and after on them.
        chain: the numbers of the chain of measurement, as found and as usual.
        ranking: what was considered, best first.
        seconds: processor time by stage.
        shown: predictions for the page.
    """

    findings: tuple[Finding, ...]
    joints: Mapping[str, JointGap]
    doubts: tuple[str, ...]
    untold: tuple[str, ...]
    cannot_tell: tuple[str, ...]
    base: RobotModel
    model: RobotModel
    choice: Mapping[str, Any] = field(default_factory=dict)
    gap: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    loss: Mapping[str, Any] = field(default_factory=dict)
    chain: Sequence[Mapping[str, Any]] = ()
    ranking: Sequence[Mapping[str, Any]] = ()
    seconds: Mapping[str, float] = field(default_factory=dict)
    shown: Mapping[str, Any] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """``named``; ``ambiguous``: a finding has several names; ``unknown``: a joint lacks what no effect explains, or
        nothing can be told; ``nothing_missing``."""
        if self.findings:
            return "ambiguous" if any(finding.alternatives for finding in self.findings) else "named"
        lost = (self.cannot_tell and not self.joints) or any(gap.flagged for gap in self.joints.values())
        return "unknown" if lost else "nothing_missing"

    @property
    def sentence(self) -> str:
        """The verdict in a few sentences, what speaks against it first."""
        first = "".join(f"The base is in doubt: {text}. " for text in self.doubts)
        if self.cannot_tell and not self.joints:
            return first + " ".join(self.cannot_tell)
        flagged = [joint for joint, gap in self.joints.items() if gap.flagged]
        odd = f" What {', '.join(flagged)} does, no effect of the catalogue explains." if flagged else ""
        if not self.findings:
            said = "Nothing is missing that these logs show." if not flagged else "No effect of the catalogue is named."
            return first + said + odd
        for verb, likely in (("lacks", True), ("may lack", False)):
            if said := "; ".join(_stated(finding) for finding in self.findings if finding.likely == likely):
                first += f"The model {verb} {said}. "
        return first.rstrip() + odd

    def plain(self) -> dict[str, Any]:
        """The content of ``verdict.yaml``."""
        return {
            "verdict": self.verdict,
            "sentence": self.sentence,
            "base": plain({"doubts": self.doubts, "untold": self.untold, "chain": self.chain}),
            "findings": [plain(one) | {"separate_by": one.separate_by} for one in self.findings],
            **{
                name: plain(getattr(self, name))
                for name in ("joints", "cannot_tell", "choice", "gap", "loss", "ranking", "seconds")
            },
        }


def separating(effects: Iterable[str]) -> str:
    """What the catalogue says would separate some effects, by their names, each experiment once."""
    return "; ".join(dict.fromkeys(filter(None, (effect_class(name).separating_experiment for name in effects))))


def _stated(finding: Finding) -> str:
    either = [finding.phrase, *(_place(r.effect, r.joints, r.shared) for r in finding.alternatives)]
    return f"{', or '.join(either)}, with probability {finding.probability:.2f}"


def _place(effect: str, joints: Sequence[str], shared: bool) -> str:
    return effect if shared else f"{effect} in {' and '.join(joints)}"


def plain(value: Any) -> Any:
    """Plain values for YAML, numbers with four digits."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value
