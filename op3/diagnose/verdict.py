"""The verdict of a diagnosis, and how it is written."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from op3.diagnose.coordinates import CHAIN
from op3.robot.joints import JOINTS
from op3.servo import RobotModel

VERDICTS = ("named", "ambiguous", "unknown", "nothing_missing")


@dataclass(frozen=True)
class Finding:
    """One effect of a verdict.

    Attributes:
        name: of the catalogue.
        joints: names of the joints in which it sits.
        shared: whether all joints have it alike.
        size: of its size parameter, in the unit.
        unit: of the size.
        interval: 90 % interval of the size.
        confidence: share of bootstrap resamples in which it wins.
        parameters: all numbers of the effect.
        gain: share of the window residual of the choosing runs that it explains.
        parameter: name of the size parameter.
        by: field of the metadata by which logs differ in it; the size is then how far the values are apart.
        instead_of: name of the effect before it from which the logs do not tell it; empty for what is named.
    """

    name: str
    joints: tuple[str, ...]
    shared: bool
    size: float
    unit: str
    interval: tuple[float, float]
    confidence: float
    parameters: Mapping[str, float]
    gain: float
    parameter: str = ""
    by: str = ""
    instead_of: str = ""

    def plain(self) -> dict[str, Any]:
        """Plain values for YAML."""
        return {
            "name": self.name,
            **({"by": self.by} if self.by else {}),
            **({"instead_of": self.instead_of} if self.instead_of else {}),
            "joints": list(self.joints),
            "shared": self.shared,
            "size": _rounded(self.size),
            "parameter": self.parameter,
            "unit": self.unit,
            "interval": [_rounded(end) for end in self.interval],
            "confidence": round(self.confidence, 3),
            "parameters": {name: _rounded(value) for name, value in self.parameters.items()},
            "gain": round(self.gain, 4),
        }


@dataclass(frozen=True, eq=False)
class Verdict:
    """What a diagnosis says.

    Attributes:
        verdict: ``named``, ``ambiguous``, ``unknown`` or ``nothing_missing``.
        effects: those named, behind each what the logs do not tell from it, or the candidates of weak logs.
        reason: one sentence.
        model: with what was named, or of what looks alike the first, switched on and identified; the refitted base
            otherwise.
        base: the refitted base model.
        separate_by: experiment that tells candidates apart; empty unless ambiguous.
        cannot_tell: what the logs are too poor for, and what to record next; empty if they are rich enough.
        assumed: sentences about what the logs do not tell and was taken for granted.
        weak: whether `cannot_tell` speaks against the names, which are candidates then, and the model is left
            without; or, where nothing was found, against there being nothing.
        gap: by channel, before and after on the runs that show.
        loss: ``paper_eq7`` before and after on the runs that show.
        vetoed: whether free runs on the runs that show speak against it, see `op3.diagnose.show.vetoed`.
        share: how far from base to what windows ask for the model lies, where free runs bear no more; 1: all the way.
        details: tables for the page: ranking, cells of residual torque, what a black box explains.
    """

    verdict: str
    effects: tuple[Finding, ...]
    reason: str
    model: RobotModel
    base: RobotModel
    separate_by: str = ""
    cannot_tell: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()
    weak: bool = False
    gap: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    loss: Mapping[str, Any] = field(default_factory=dict)
    vetoed: bool = False
    share: float = 1.0
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """The verdict in one sentence."""
        if self.weak and not self.effects:
            return "These logs cannot tell whether anything is missing: " + " ".join(self.cannot_tell)
        if self.weak:
            either = ", or ".join(_phrase(effect) for effect in self.effects)
            return f"These logs cannot tell what is missing; what they have points to {either}."
        if self.verdict == "named" and self.vetoed:
            return f"Windows ask for {self.found}, but free runs are no better with it; the model was left without."
        if self.verdict == "named":
            held = (
                "" if self.share == 1.0 else f"; the new one holds {self.share:.0%} of that, as free runs bear no more"
            )
            return f"The model lacks {self.found}{held}."
        if self.verdict == "ambiguous":
            left = "; free runs are no better with the first, and the model was left without" if self.vetoed else ""
            return f"The model lacks {self.found}; these logs do not tell which{left}."
        if self.verdict == "unknown" and not self.details.get("ranking"):
            return "These logs cannot tell what is missing: " + " ".join(self.cannot_tell)
        if self.verdict == "unknown":
            return "The model lacks something that no effect of the catalogue explains."
        if self.cannot_tell:
            return "Nothing is missing that these logs show; of some joints or effects they cannot tell."
        return "Nothing is missing that these logs show: no effect of the catalogue explains more than chance would."

    @property
    def found(self) -> str:
        """All effects, each with those that could stand for it."""
        groups: list[list[str]] = []
        for effect in self.effects:
            groups = [*groups, []] if not effect.instead_of or not groups else groups
            groups[-1].append(_phrase(effect))
        link = "; besides, " if any(len(group) > 1 for group in groups) else " and "
        return link.join(", or ".join(group) for group in groups)

    def measurement_chain(self) -> list[dict[str, Any]]:
        """What the base takes for granted of every chain of measurement, as found: small lags, zeros and presliding.

        Of what joints have each for itself the one furthest from what is expected. A lag that is larger than any
        servo's is an effect that the base has taken upon itself, and is told by its ``deviations``.
        """
        known, told = self.base.parameters(), []
        for name, (expected, deviation, _) in CHAIN.items():
            if name in known:
                values = self.base.tensors(list(self.details.get("joints", ())) or JOINTS)[name][0].numpy()
                found = float(values[abs(values - expected).argmax()])
                apart = round((found - expected) / deviation, 1)
                entry = {"name": name, "found": _rounded(found), "expected": expected, "unit": known[name].unit}
                told.append({**entry, "deviations": apart})
        return told

    def plain(self) -> dict[str, Any]:
        """The content of ``verdict.yaml``."""
        content: dict[str, Any] = {
            "verdict": self.verdict,
            "sentence": self.sentence,
            "reason": self.reason,
            "effects": [effect.plain() for effect in self.effects],
        }
        if self.separate_by:
            content["separate_by"] = self.separate_by
        if self.cannot_tell:
            content["cannot_tell"] = list(self.cannot_tell)
        if self.assumed:
            content["assumed"] = list(self.assumed)
        content["gap"] = {name: dict(values) for name, values in self.gap.items()}
        content["loss"] = dict(self.loss)
        content["vetoed"] = self.vetoed
        content["share"] = self.share
        content["located"] = list(self.details.get("located", ()))
        content["ceiling"] = dict(self.details.get("ceiling", {}))
        content["measurement_chain"] = self.measurement_chain()
        content["ranking"] = self._ranking()
        return content

    def _ranking(self) -> list[dict[str, Any]]:
        """What was considered in the first round, best first, behind what was named in the end."""
        considered = list(self.details.get("ranking", ()))
        first = []
        for effect in self.effects:
            same = [one for one in considered if (one["name"], set(one["joints"])) == (effect.name, set(effect.joints))]
            first.append(same[0] if same else {"name": effect.name, "joints": list(effect.joints)})
        return first + [one for one in considered if one not in first]


def _phrase(effect: Finding) -> str:
    where = "in all joints" if effect.shared else "in " + ", ".join(effect.joints)
    if len(effect.joints) == 1 and effect.shared:
        where = "in the servo"
    if effect.by:
        where = f"that differs by {effect.by}"
    low, high = effect.interval
    unit = "" if effect.unit == "-" else f" {effect.unit}"
    # where the number is not the effect's own, say which it is
    which = "" if not effect.parameter or effect.name in effect.parameter else f"{effect.parameter} "
    return f"{effect.name} {where}, {which}{effect.size:.3g}{unit} ({low:.3g} to {high:.3g})"


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
