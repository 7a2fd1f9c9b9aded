"""Scores of verdicts: one case compared with its answer, many cases as rates with intervals.

The scores depend only on `verdict.yaml`, which a diagnosis writes:

    findings:          # effects that the model does not include; an empty list if no effect is named
    - effect: backlash
      joints: [elbow]            # all joints of the robot, or an empty list: everywhere
      probability: 0.93
      size: 0.004                 # optional, with the catalogue's `parameter` and its 90 % `interval`
      interval: [0.003, 0.005]
      parameter: backlash_half_gap
      of_base: false              # whether it is an unusual value of a parameter that every baseline fit includes
      alternatives: [{effect: compliance, joints: [elbow], probability: 0.05}]
    gap: {<channel>: {before, after, floor}}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.stats import bootstrap

from op3.common.sample_intervals import wilson_interval
from op3.stand_in.hidden import KINDS, SEVERITIES

CONFIDENT = 0.8
"""A wrong finding with a probability above this counts as confident and wrong."""

NAMED = 0.5
"""Probability above which a finding counts as a name; other findings only count in the calibration."""

SAME: dict[str, str] = {"payload": "link_mass", "com_offset": "link_com"}
"""Names of trunk effects, and of the link effects to which they correspond in a joint."""

BINS = 5
"""Bins of stated probability in the calibration table."""

MISSING = "no_verdict"
"""Claim for a case whose diagnosis failed."""

NOTHING = "nothing"
"""Claim for a verdict without a name."""


@dataclass(frozen=True)
class BenchFinding:
    """One effect that a verdict names or an answer hides.

    Attributes:
        name: name of the effect.
        joints: joints of the effect; empty: all joints.
        probability: stated probability that the effect is present.
        size: size in the unit of the bench's table; None if not given in this unit.
        interval: 90 % interval of the size, lowest and highest value.
        others: alternatives.
        of_base: whether it is an unusual value of a parameter that every baseline fit includes; ignored if not hidden.
    """

    name: str
    joints: tuple[str, ...] = ()
    probability: float = 1.0
    size: float | None = None
    interval: tuple[float, float] | None = None
    others: tuple[BenchFinding, ...] = ()
    of_base: bool = False

    def same(self, other: BenchFinding) -> bool:
        """Whether name and joints agree."""
        return self.name == other.name and self.joints == other.joints


@dataclass(frozen=True)
class BenchVerdict:
    """Verdict of a diagnosis.

    Attributes:
        findings: the most probable first.
        gap: `before`, `after` and `floor` by channel.
        failed: whether the diagnosis wrote no verdict.
    """

    findings: tuple[BenchFinding, ...] = ()
    gap: Mapping[str, Any] | None = None
    failed: bool = False


def read_verdict(path: str | Path, joints: Sequence[str]) -> BenchVerdict:
    """Read `verdict.yaml`.

    Args:
        path: path of the file.
        joints: joints of the robot.

    Raises:
        ValueError: if the file does not have the format above; the message names the entry.
    """
    path = Path(path)
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
    entries = values.get("findings") if isinstance(values, Mapping) else None
    if not isinstance(entries, list):
        raise ValueError(f"{path}: write `findings:` with a list, which is empty if no effect is missing")
    found = sorted((_finding(path, entry, joints) for entry in entries), key=lambda one: -one.probability)
    return BenchVerdict(tuple(found), values.get("gap") or {})


def _finding(path: Path, entry: Any, joints: Sequence[str]) -> BenchFinding:
    if not isinstance(entry, Mapping) or not isinstance(entry.get("effect"), str):
        raise ValueError(f"{path}: a finding has no `effect`, got {entry!r}")
    name, probability = str(entry["effect"]), entry.get("probability")
    if isinstance(probability, bool) or not isinstance(probability, int | float) or not 0 <= probability <= 1:
        raise ValueError(f"{path}: probability of {name} must be a number between 0 and 1, got {probability!r}")
    where = _normal(entry.get("joints") or (), joints)
    name = SAME.get(name, name) if where else name
    size, interval = _size(path, name, entry)
    others = tuple(_finding(path, {"probability": 0.0, **other}, joints) for other in entry.get("alternatives") or ())
    return BenchFinding(name, where, float(probability), size, interval, others, bool(entry.get("of_base")))


def _size(path: Path, name: str, entry: Mapping[str, Any]) -> tuple[float | None, tuple[float, float] | None]:
    """Size and interval, if they are given for the parameter in the bench's table."""
    kind, size, interval = KINDS.get(name), entry.get("size"), entry.get("interval")
    if interval is not None and (not isinstance(interval, Sequence) or len(interval) != 2):
        raise ValueError(f"{path}: interval of {name} must be [low, high], got {interval!r}")
    if kind is None or size is None or entry.get("parameter") not in (None, kind.parameter):
        return None, None
    return float(size), None if interval is None or None in interval else (float(interval[0]), float(interval[1]))


def _normal(where: str | Sequence[str], joints: Sequence[str]) -> tuple[str, ...]:
    """Sorted joints; empty, which means everywhere, for all joints or none."""
    inside = {where} if isinstance(where, str) else set(where)
    return () if inside >= set(joints) else tuple(sorted(inside))


def truth_of(answer: Mapping[str, Any]) -> tuple[BenchFinding, ...]:
    """The hidden effects of an answer as findings, with sizes in the catalogue's parameters."""
    return tuple(
        BenchFinding(
            effect["name"],
            () if effect["shared"] else tuple(sorted(effect["joints"])),
            size=KINDS[effect["name"]].catalogue_size(float(effect["size"])),
        )
        for effect in answer["effects"]
    )


def score_case(
    answer: Mapping[str, Any], verdict: BenchVerdict, cost: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """Score of one case as plain values; None if a score does not apply.

    Args:
        answer: the hidden effects.
        verdict: verdict of the diagnosis.
        cost: cost of the diagnosis, as `hidden_bench.bench.Cost`.

    Returns:
        `exact`: the most probable name and its joints are correct; `name`, `joints`: only the name, or only the joints,
        are correct (joints: if the name is correct and the effect is not everywhere); `family`: exact, or one of its
        alternatives is; `clean`: no name is wrong; `both`, and `one`: at least one correct and none wrong (pairs);
        `named`: there is any name (null cases and outsiders); `confident_wrong`: a confident finding is wrong;
        `stated`: probability of every finding, and whether it is correct; `covered`, `size_ratio`: of the first
        correct name with a size; `closure`: share of the gap above the noise floor that was closed;
        `processor_seconds`, `seconds`, `peak_memory`.
    """
    truth, kind = truth_of(answer), answer["kind"]
    told = kind in ("single", "pair", "poor")

    def right(finding: BenchFinding) -> bool:
        return any(finding.same(one) for one in truth)

    findings = tuple(one for one in verdict.findings if right(one) or not one.of_base)
    names = tuple(one for one in findings if one.probability > NAMED)
    first = names[0] if names else None

    row: dict[str, Any] = {
        **{key: answer.get(key) for key in ("case", "kind", "robot", "severity")},
        "truth": "+".join(one.name for one in truth) or NOTHING,
        "truth_joints": ",".join(truth[0].joints) if len(truth) == 1 else "",
        "claim": first.name if first else MISSING if verdict.failed else NOTHING,
        "claim_joints": ",".join(first.joints) if first else "",
        "probability": first.probability if first else None,
    }
    same_name = [one for one in truth if first is not None and one.name == first.name]
    exact = first is not None and right(first)
    row["exact"] = exact if told else None
    row["name"] = bool(same_name) if told else None
    row["joints"] = first.joints == same_name[0].joints if first and same_name and same_name[0].joints else None
    row["family"] = exact or (first is not None and any(map(right, first.others))) if told else None
    wrong = [finding for finding in names if not right(finding)]
    row["clean"] = not wrong if told else None
    found = [any(finding.same(one) for finding in names) for one in truth]
    row["both"] = all(found) if kind == "pair" else None
    row["one"] = any(found) and not wrong if kind == "pair" else None
    row["named"] = bool(names) if not told else None
    row["confident_wrong"] = any(one.probability > CONFIDENT and not right(one) for one in findings)
    row["stated"] = [[finding.probability, right(finding)] for finding in findings]
    row.update(_compared(truth, names))
    row["closure"] = closure(verdict.gap or {}) if names else None
    return {**row, **{key: (cost or {}).get(key) for key in ("processor_seconds", "seconds", "peak_memory")}}


def _compared(truth: Sequence[BenchFinding], names: Sequence[BenchFinding]) -> dict[str, Any]:
    """For the first correct name with a size: whether its interval contains the true size, and the ratio of both."""
    for finding in names:
        for one in truth:
            if finding.same(one) and finding.size is not None and one.size:
                within = finding.interval
                covered = None if within is None else within[0] <= one.size <= within[1]
                return {"covered": covered, "size_ratio": finding.size / one.size}
    return {"covered": None, "size_ratio": None}


def closure(gap: Mapping[str, Any]) -> float | None:
    """Share (before - after)/(before - floor) of the gap that was closed, mean over channels; None without a gap."""
    shares = [
        (channel["before"] - channel["after"]) / (channel["before"] - channel["floor"])
        for channel in gap.values()
        if isinstance(channel, Mapping)
        and all(isinstance(channel.get(key), int | float) for key in ("before", "after", "floor"))
        and channel["before"] > channel["floor"]
    ]
    return float(np.clip(np.mean(shares), -1.0, 1.0)) if shares else None


def rate(values: Sequence[bool | None]) -> dict[str, Any] | None:
    """Share of true values among those that are not None, with its interval; None if all are None."""
    asked = [bool(value) for value in values if value is not None]
    if not asked:
        return None
    low, high = wilson_interval(sum(asked), len(asked))
    return {"value": sum(asked) / len(asked), "low": low, "high": high, "count": sum(asked), "of": len(asked)}


_CLEAR = tuple(SEVERITIES)[1:]

RATES: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "clear_exact": ("exact", ("single",), _CLEAR),
    "clear_family": ("family", ("single",), _CLEAR),
    **{f"{severity}_exact": ("exact", ("single",), (severity,)) for severity in (*_CLEAR[1:], *tuple(SEVERITIES)[:1])},
    "name": ("name", ("single",), ()),
    "joints": ("joints", ("single", "pair", "poor"), ()),
    "clean": ("clean", ("single", "poor"), ()),
    "pairs_both": ("both", ("pair",), ()),
    "pairs_one": ("one", ("pair",), ()),
    "sound_named": ("named", ("null",), ()),
    "outsiders_named": ("named", ("outsider",), ()),
    "poor_family": ("family", ("poor",), ()),
    "confident_wrong": ("confident_wrong", (), ()),
    "size_coverage": ("covered", (), ()),
}
"""Rates of a summary: the entry of a case's score, and the kinds and severities of the cases that count; empty: all."""


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rates with Wilson's intervals, calibration in five bins, medians with bootstrap intervals."""
    summary: dict[str, Any] = {"cases": len(rows), "failed": sum(row["claim"] == MISSING for row in rows)}
    for name, (entry, kinds, severities) in RATES.items():
        of = [row for row in rows if not kinds or row["kind"] in kinds]
        summary[name] = rate([row[entry] for row in of if not severities or row["severity"] in severities])
    summary["calibration"] = calibration([one for row in rows for one in row["stated"]])
    for entry in ("closure", "size_ratio", "processor_seconds", "seconds", "peak_memory"):
        summary[f"{entry}_median"] = median([row[entry] for row in rows if row[entry] is not None])
    return summary


def median(values: Sequence[float]) -> dict[str, Any] | None:
    """Median with its 95 % bootstrap interval over cases, which has zero width for equal values; None without cases."""
    if not values:
        return None
    low = high = float(np.median(values))
    if min(values) < max(values):
        low, high = bootstrap((values,), np.median, method="percentile", rng=len(values)).confidence_interval
    return {"value": float(np.median(values)), "low": float(low), "high": float(high), "of": len(values)}


def calibration(stated: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """How far stated probabilities can be trusted.

    Args:
        stated: probability of each finding, and whether it was right.

    Returns:
        `ece`: the mean over findings of |probability - share of correct findings| in their bin; None without findings.
        `reliability`: for each bin with findings, mean probability, share of correct findings with Wilson's interval
        (low, high), and number of findings. `findings`: their total number.
    """
    table = []
    for fifth in range(BINS):
        here = [(p, bool(right)) for p, right in stated if min(int(p * BINS), BINS - 1) == fifth]
        if here:
            count = sum(right for _, right in here)
            mean = float(np.mean([p for p, _ in here]))
            table.append([mean, count / len(here), *wilson_interval(count, len(here)), len(here)])
    apart = [abs(mean - share) * number for mean, share, _, _, number in table]
    return {"ece": sum(apart) / len(stated) if stated else None, "reliability": table, "findings": len(stated)}


def random_name(names: Sequence[str], joints: Sequence[str], rng: np.random.Generator) -> BenchVerdict:
    """Baseline: a random effect, in all joints or in one joint with equal probability."""
    where = () if rng.random() < 0.5 else (str(rng.choice(joints)),)
    return BenchVerdict((BenchFinding(str(rng.choice(names)), where),))
