"""The verdict: findings, unexplained torque of every joint, and doubts about the baseline fit."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from op3.common.plain_names import words
from op3.diagnose.held_out import Gain
from op3.diagnose.window_gaps import WindowGaps, plain_gaps
from op3.servo import RobotModel, effect_class

LIKELY = 0.5
"""Display: probability above which a finding is likely, and the largest probability for short logs."""


@dataclass(frozen=True)
class Alternative:
    """Another effect that predicts the left-out runs as well as a finding."""

    effect: str
    joints: tuple[str, ...]
    shared: bool
    probability: float


@dataclass(frozen=True)
class Finding:
    """One effect that the model does not include, or an unusual parameter of the measurement chain.

    Attributes:
        effect: name in the catalogue.
        joints: names of its joints.
        shared: whether all joints have the same value.
        parameter: name of the parameter that sets the size of the effect.
        size: value of this parameter; for an effect that the baseline includes, the increment.
        unit: unit of the size.
        interval: 90 % interval of the size.
        probability: probability of this effect and these joints.
        log_odds: log evidence ratio in the fitted windows.
        gain: gain on left-out runs of the model with the effect over the model without it.
        alternatives: effects that are not distinguishable from this one, with probabilities.
        torque: RMS torque in the joints with the largest torque [N m].
        load: largest ratio of this torque to a joint's RMS torque.
        of_base: whether it is an unusual value of a parameter that every baseline fit includes.
        opened: gain in standard errors after widening the bounds of baseline parameters that ended at a bound; None if
            no parameter did.
        beyond: whether the size reached the end of the searched range, so that the true size may be larger.
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
        """The experiments that would distinguish it from its alternatives."""
        names = [self.effect, *(other.effect for other in self.alternatives)] if self.alternatives else []
        return separating(names)

    @property
    def likely(self) -> bool:
        """Whether the finding and its alternatives together have a probability above `LIKELY`."""
        return self.probability + sum(other.probability for other in self.alternatives) > LIKELY

    @property
    def phrase(self) -> str:
        """Effect, joints and size in a few words."""
        size = f"{self.size:.3g} {self.unit}".removesuffix(" -")  # dimensionless values have no unit
        size = f"at least {size}, end of the searched range" if self.beyond else size
        return f"{_place(self.effect, self.joints, self.shared)} ({words(self.parameter)} {size})"


@dataclass(frozen=True)
class JointGap:
    """Residual torque of a joint, RMS over windows [N m].

    Attributes:
        before: torque under the baseline fit.
        after: torque under the returned model.
        floor: noise of the sensors.
        unexplained: part that no effect of the catalogue explains.
        flagged: whether this part exceeds the values of joints of sound robots.
        shape: share of the variance of this part that position, velocity, load and time explain.
    """

    before: float
    after: float
    floor: float
    unexplained: float
    flagged: bool
    shape: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Verdict:
    """Result of a diagnosis.

    Attributes:
        findings: the most probable first.
        joints: residual torque of each joint, by name.
        doubts: sentences about the baseline fit: parameters at a bound, other optima.
        unidentifiable: shared parameters that are not identifiable from these logs.
        cannot_tell: sentences about what the logs do not reveal and what to record.
        base: the baseline fit: the given model refitted without new effects.
        model: the returned model: the baseline with every finding.
        windows: the gap of the three models in windows of held-out runs; None if there are no windows.
        gap: errors by channel, before and after, in free-run simulations of held-out runs.
        loss: ``paper_eq7`` before and after on these runs.
        chain: parameters of the measurement chain, fitted and usual.
        ranking: hypotheses before any effect was named, the best first.
        ends: -2 log evidence of the other optima of the baseline fit minus that of the best.
        not_shown: effects that these logs would not reveal at any plausible size, with the joints.
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
        """``named``; ``ambiguous``: a finding has alternatives; ``unknown``: no finding, but a joint has unexplained
        torque or the logs show nothing; ``nothing_missing``."""
        if self.findings:
            return "ambiguous" if any(finding.alternatives for finding in self.findings) else "named"
        unknown = (self.cannot_tell and not self.joints) or any(gap.flagged for gap in self.joints.values())
        return "unknown" if unknown else "nothing_missing"

    @property
    def sentence(self) -> str:
        """The verdict in a few sentences."""
        if self.cannot_tell and not self.joints:
            return " ".join(self.cannot_tell)
        flagged = [words(joint) for joint, gap in self.joints.items() if gap.flagged]
        odd = f" No effect of the catalogue explains the remaining torque of {', '.join(flagged)}." if flagged else ""
        if not self.findings:
            said = "These logs show no missing effect." if not flagged else "No effect of the catalogue is named."
            said = " ".join([said, *self.cannot_tell])
        else:
            said = "; ".join(_stated(finding) for finding in self.findings)
            said = f"The model does not include {said}."
        return f"{said}{odd} {self.gap_sentence}".rstrip()

    @property
    def gap_sentence(self) -> str:
        """The gap of the three models in windows of held-out runs."""
        if self.windows is None:
            return ""
        gap = self.windows.whole["position"]
        floor = "" if gap.floor is None else f"; repeats differ by {1e3 * gap.floor:.2f} mrad"
        worse = (
            f" The baseline fit of {', '.join(map(words, self.windows.worse))} is worse than the given model."
            if self.windows.worse
            else ""
        )
        return (
            f"RMS angle error in {self.windows.length:.2g} s windows of held-out runs:"
            f" given model {1e3 * gap.given:.2f} mrad, baseline fit {1e3 * gap.baseline:.2f} mrad,"
            f" returned model {1e3 * gap.returned:.2f} mrad{floor}.{worse}"
        )

    def plain(self) -> dict[str, Any]:
        """The content of ``verdict.yaml``."""
        return {
            "verdict": self.verdict,
            "sentence": self.sentence,
            "base": plain({name: getattr(self, name) for name in ("doubts", "unidentifiable", "chain", "ends")}),
            "findings": [plain(finding) | {"separate_by": finding.separate_by} for finding in self.findings],
            **{
                name: plain(getattr(self, name))
                for name in ("joints", "cannot_tell", "not_shown", "gap", "loss", "ranking", "seconds")
            },
            "windows": None if self.windows is None else plain(plain_gaps(self.windows)),
        }


def separating(effects: Iterable[str]) -> str:
    """The catalogue's experiments that separate these effects, each once."""
    return "; ".join(dict.fromkeys(filter(None, (effect_class(name).separating_experiment for name in effects))))


def _stated(finding: Finding) -> str:
    names = [finding.phrase, *(_place(r.effect, r.joints, r.shared) for r in finding.alternatives)]
    return f"{', or '.join(names)}, with probability {finding.probability:.2f}"


def _place(effect: str, joints: Sequence[str], shared: bool) -> str:
    in_joints = "joint" in effect_class(effect).scopes
    where = ("all joints" if len(joints) > 1 and in_joints else "") if shared else " and ".join(map(words, joints))
    return f"{words(effect)} in {where}" if where else words(effect)


def plain(value: Any) -> Any:
    """Values for YAML, numbers with four digits."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value
