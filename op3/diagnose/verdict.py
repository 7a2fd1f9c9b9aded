"""A verdict: findings, what stays unexplained in every joint, and how far its base can be trusted."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from op3.common.plain_names import words
from op3.diagnose.held_out import Gain
from op3.diagnose.window_gaps import WindowGaps, plain_gaps
from op3.servo import RobotModel, effect_class

LIKELY = 0.5
"""Probability beyond which a finding is a name; at most that of findings on a base in doubt."""


@dataclass(frozen=True)
class Alternative:
    """A name that is not distinguished from a finding's."""

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
        log_odds: of the evidence by which it was proposed.
        gain: by how much the model with it predicts runs that were left out better than the model without.
        alternatives: what it could be confused with, with probabilities.
        torque: what it makes in the joints that feel it most [N m], root mean square.
        load: largest share of a joint's torque that this is.
        of_base: whether it is a number that every baseline fit has, far from what is usual.
        opened: its gain in standard errors with the ranges opened of those numbers of the baseline that ended at a
            bound; None where none did.
        beyond: whether its size ended where the searched range does: it may be larger.
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
    gain: Gain
    alternatives: tuple[Alternative, ...] = ()
    torque: Mapping[str, float] = field(default_factory=dict)
    load: float = 0.0
    of_base: bool = False
    beyond: bool = False
    opened: float | None = None

    @property
    def separate_by(self) -> str:
        """The experiments that would tell it from its alternatives."""
        names = [self.effect, *(other.effect for other in self.alternatives)] if self.alternatives else []
        return separating(names)

    @property
    def likely(self) -> bool:
        """Whether it, or one of its alternatives, is more likely there than not."""
        return self.probability + sum(other.probability for other in self.alternatives) > LIKELY

    @property
    def phrase(self) -> str:
        """Name, place and size in a few words."""
        size = f"{self.size:.3g} {self.unit}".removesuffix(" -")  # pure numbers have no unit
        size = f"at least {size}, end of the searched range" if self.beyond else size
        return f"{_place(self.effect, self.joints, self.shared)} ({words(self.parameter)} {size})"


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
        doubts: sentences about the baseline fit: numbers at a bound, other optima.
        unidentifiable: shared numbers that are not identifiable from these logs.
        cannot_tell: what the logs do not show, and what to record.
        base: the baseline fit: the given model refitted without new effects.
        model: the returned model: the baseline with every finding.
        windows: the gap in windows of held-out runs, in three stages; None where there are no windows.
        gap: by channel, before and after in free-run simulations of runs that nothing was chosen by.
        loss: ``paper_eq7`` before and after on them.
        chain: the numbers of the chain of measurement, as found and as usual.
        ranking: what was considered, best first.
        ends: by how much the other best starts of the baseline fit end worse, in minus two log evidence.
        not_shown: effects that these logs would not show at any plausible size, and in which joints.
        seconds: processor time by stage.
        shown: predictions for the page.
    """

    findings: tuple[Finding, ...]
    joints: Mapping[str, JointGap]
    doubts: tuple[str, ...]
    unidentifiable: tuple[str, ...]
    cannot_tell: tuple[str, ...]
    base: RobotModel
    model: RobotModel
    windows: WindowGaps | None = None
    gap: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    loss: Mapping[str, Any] = field(default_factory=dict)
    chain: Sequence[Mapping[str, Any]] = ()
    ranking: Sequence[Mapping[str, Any]] = ()
    ends: tuple[float, ...] = ()
    not_shown: Mapping[str, Sequence[str]] = field(default_factory=dict)
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
        """The verdict in a few sentences."""
        if self.cannot_tell and not self.joints:
            return " ".join(self.cannot_tell)
        flagged = [words(joint) for joint, gap in self.joints.items() if gap.flagged]
        odd = f" No effect of the catalogue explains the remaining torque of {', '.join(flagged)}." if flagged else ""
        if not self.findings:
            said = "These logs show no missing effect." if not flagged else "No effect of the catalogue is named."
        else:
            said = "; ".join(_stated(finding) for finding in self.findings)
            said = f"The model does not include {said}."
        return f"{said}{odd} {self.gap_sentence}".rstrip()

    @property
    def gap_sentence(self) -> str:
        """The gap in windows of held-out runs in three stages."""
        if self.windows is None:
            return ""
        one = self.windows.whole["position"]
        floor = "" if one.floor is None else f"; repeats differ by {1e3 * one.floor:.2f} mrad"
        worse = (
            f" The baseline fit of {', '.join(map(words, self.windows.worse))} is worse than the given model."
            if self.windows.worse
            else ""
        )
        return (
            f"RMS angle error in {self.windows.length:.2g} s windows of held-out runs:"
            f" given model {1e3 * one.given:.2f} mrad, baseline fit {1e3 * one.baseline:.2f} mrad,"
            f" returned model {1e3 * one.returned:.2f} mrad{floor}.{worse}"
        )

    def plain(self) -> dict[str, Any]:
        """The content of ``verdict.yaml``."""
        return {
            "verdict": self.verdict,
            "sentence": self.sentence,
            "base": plain({name: getattr(self, name) for name in ("doubts", "unidentifiable", "chain", "ends")}),
            "findings": [plain(one) | {"separate_by": one.separate_by} for one in self.findings],
            **{
                name: plain(getattr(self, name))
                for name in ("joints", "cannot_tell", "not_shown", "gap", "loss", "ranking", "seconds")
            },
            "windows": None if self.windows is None else plain(plain_gaps(self.windows)),
        }


def separating(effects: Iterable[str]) -> str:
    """What the catalogue says would separate some effects, by their names, each experiment once."""
    return "; ".join(dict.fromkeys(filter(None, (effect_class(name).separating_experiment for name in effects))))


def _stated(finding: Finding) -> str:
    either = [finding.phrase, *(_place(r.effect, r.joints, r.shared) for r in finding.alternatives)]
    return f"{', or '.join(either)}, with probability {finding.probability:.2f}"


def _place(effect: str, joints: Sequence[str], shared: bool) -> str:
    in_joints = "joint" in effect_class(effect).scopes
    where = ("all joints" if len(joints) > 1 and in_joints else "") if shared else " and ".join(map(words, joints))
    return f"{words(effect)} in {where}" if where else words(effect)


def plain(value: Any) -> Any:
    """Plain values for YAML, numbers with four digits."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value
