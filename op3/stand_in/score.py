"""What a verdict is worth: one case against its answer, many cases as rates with intervals.

It reads `verdict.yaml` as a diagnosis writes it and knows nothing of how the verdict was found:

    verdict: named | ambiguous | unknown | nothing_missing
    effects: [{name, joints, size, unit, interval, confidence}]   # of an ambiguous verdict: the candidates
    separate_by: ...                                              # what would separate them
    ranking: [{name, joints, gain, score}]                        # best first; score: of a score test, if made
    gap: {<channel>: {before, after, floor, ceiling}}
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from op3.robot import LEG_JOINTS

VERDICTS: tuple[str, ...] = ("named", "ambiguous", "unknown", "nothing_missing")
"""What a diagnosis may conclude."""

CONFIDENT = 0.8
"""A stated confidence beyond this that turns out wrong has misled somebody."""

SAME: dict[str, str] = {"payload": "link_mass", "com_offset": "link_com"}
"""Names of effects of the trunk, which is fixed here, and of the link effects that they mean in one joint of a leg."""

PARAMETERS: tuple[str, ...] = (
    "static_friction_excess",
    "load_friction",
    "bristle_compliance",
    "backlash_half_gap",
    "gear_compliance",
    "cogging_amplitude",
    "cable_stiffness",
    "position_friction",
    "asymmetric_friction",
    "quadratic_drag",
    "friction_drift",
    "torque_constant_error",
    "magnet_temperature_coefficient",
    "terminal_resistance_error",
    "supply_resistance",
    "current_time_constant",
    "current_offset",
    "command_latency",
    "drop_probability",
    "velocity_time_constant",
    "encoder_offset",
    "encoder_nonlinearity",
    "link_mass_offset",
    "link_com_offset_x",
    "coulomb_friction",
    "viscous_friction",
    "gyration_squared",
)
"""Parameters of the catalogue that mean what the bench's table calls the size of their effect."""

MISSING = "no_verdict"
"""Verdict of a case whose diagnosis failed."""


@dataclass(frozen=True)
class Claim:
    """One effect that a verdict names.

    Attributes:
        name: of the effect.
        joints: where; empty: everywhere.
        size: in the unit of the bench's table, None where not given in it.
        interval: lowest and highest size, 90 %.
        confidence: 0 to 1, None where not stated.
        score: statistic of a score test, None where none was made.
        gain: share of the residual that it explains, None where not stated.
    """

    name: str
    joints: tuple[str, ...] = ()
    size: float | None = None
    interval: tuple[float, float] | None = None
    confidence: float | None = None
    score: float | None = None
    gain: float | None = None

    def same(self, other: Claim) -> bool:
        """Whether name and joints agree."""
        return self.name == other.name and self.joints == other.joints


@dataclass(frozen=True)
class Verdict:
    """What a diagnosis concluded.

    Attributes:
        verdict: one of `VERDICTS`, or `MISSING`.
        claims: effects named, best first.
        ranking: all effects considered, best first.
        gap: by channel, `before`, `after`, `floor` and perhaps `ceiling`.
        black_box: share of the residual that a black box explains, without a name; None if not said.
        returns: of a policy, see `returns_error`.
        cannot_tell: whether it says that the logs are too poor.
        processor_seconds: CPU time that it took; None if not said.
    """

    verdict: str
    claims: tuple[Claim, ...] = ()
    ranking: tuple[Claim, ...] = ()
    gap: Mapping[str, Mapping[str, float]] | None = None
    black_box: float | None = None
    returns: Mapping[str, Any] | None = None
    cannot_tell: bool = False
    processor_seconds: float | None = None


def read_verdict(path: str | Path) -> Verdict:
    """Read `verdict.yaml`.

    Raises:
        ValueError: if it is not as described above; says which entry.
    """
    path = Path(path)
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(values, Mapping) or values.get("verdict") not in VERDICTS:
        raise ValueError(f"{path}: write `verdict:` with one of {', '.join(VERDICTS)}")
    claims = tuple(_claim(path, "effects", entry) for entry in values.get("effects") or ())
    if values["verdict"] in ("named", "ambiguous") and not claims:
        raise ValueError(f"{path}: the verdict is {values['verdict']} but `effects` is empty")
    ranking = tuple(_claim(path, "ranking", entry) for entry in values.get("ranking") or ())
    return Verdict(
        values["verdict"],
        claims,
        ranking or claims,
        values.get("gap") or {},
        (values.get("ceiling") or {}).get("gain"),
        values.get("downstream"),
        bool(values.get("cannot_tell")),
        values.get("processor_seconds"),
    )


def _claim(path: Path, field: str, entry: Any) -> Claim:
    if not isinstance(entry, Mapping) or not isinstance(entry.get("name"), str):
        raise ValueError(f"{path}: an entry of `{field}` has no name: {entry!r}")
    joints = entry.get("joints") or ()
    joints = (joints,) if isinstance(joints, str) else tuple(joints)
    confidence = entry.get("confidence")
    if confidence is not None and not 0 <= confidence <= 1:
        raise ValueError(f"{path}: confidence of {entry['name']} is {confidence}, not within 0 and 1")
    size, interval = _in_table_unit(entry)
    if interval is not None and (not isinstance(interval, list) or len(interval) != 2):
        raise ValueError(f"{path}: interval of {entry['name']} is {interval!r}, not [low, high]")
    if size is None or interval is None or None in interval:
        interval = None
    joints = _normal(joints)
    return Claim(
        SAME.get(str(entry["name"]), str(entry["name"])) if joints else str(entry["name"]),
        joints,
        None if size is None else float(size),
        None if interval is None else (float(interval[0]), float(interval[1])),
        None if confidence is None else float(confidence),
        None if entry.get("score") is None else float(entry["score"]),
        None if entry.get("gain") is None else float(entry["gain"]),
    )


def _in_table_unit(entry: Mapping[str, Any]) -> tuple[float | None, Any]:
    """Size and interval in the unit of the bench's table; None where another parameter is given."""
    size, interval = entry.get("size"), entry.get("interval")
    if entry["name"] == "dte" and entry.get("parameter") == "backward_efficiency":
        # the visible ratio, with the forward efficiency at 1; it falls as the efficiency rises
        interval = interval and [None if end is None else 1 / end - 1 for end in reversed(interval)]
        return None if size is None else 1 / size - 1, interval
    if entry["name"] in ("cogging", "encoder_nonlinearity") and size is not None and size < 0:
        # an amplitude; its sign is a matter of the phase
        return -size, interval and [None if end is None else -end for end in reversed(interval)]
    if entry.get("parameter") in (None, *PARAMETERS):
        return size, interval
    return None, None


def _normal(joints: Sequence[str]) -> tuple[str, ...]:
    """Joints in the leg's order; all of them, or none named, is everywhere."""
    inside = tuple(sorted(set(joints)))
    return () if set(inside) >= set(LEG_JOINTS) else inside


def truth_claims(answer: Mapping[str, Any]) -> tuple[Claim, ...]:
    """What an answer hides, as claims."""
    return tuple(
        Claim(effect["name"], () if effect["shared"] else _normal(effect["joints"]), float(effect["size"]))
        for effect in answer["effects"]
    )


def score_case(
    answer: Mapping[str, Any],
    verdict: Verdict,
    oracle: Mapping[str, Any] | None = None,
    actual: float | None = None,
) -> dict[str, Any]:
    """One case: plain values, None where a question does not arise.

    Args:
        answer: what was hidden.
        verdict: of the diagnosis.
        oracle: gap under a model to which the answer was told, if that was computed.
        actual: mean return of a policy in the hidden truth, if it was run there.

    Returns:
        `named_right`: first claim's name is hidden; `exact`: its joints too; `top3`: exact among the first three of the
        ranking; `class`: exact, or an ambiguous verdict with an exact candidate; `joint`: joints right where one
        joint holds the effect and its name is right; `detected`; `alarm` (nulls); `unknown_right` (outsiders); `both`
        and `one` (pairs); `extra`: a right claim beside a name that is not hidden; `confidence` and `right` of the
        first claim; `confident_wrong`: a claim, first or further, that is stated with confidence and not hidden;
        `covered`: size within the interval; `size_ratio`; `closure`: share of the gap
        beyond the noise floor that was closed; `oracle_closure`: of what the oracle closes; `explained` and
        `black_box`: share of the residual that the first claim, and a black box, explain; `processor_seconds`: CPU time
        of the diagnosis.
    """
    truth = truth_claims(answer)
    kind, claims = answer["kind"], verdict.claims if verdict.verdict in ("named", "ambiguous") else ()
    hidden = kind in ("single", "poor", "pair")
    first = claims[0] if claims else None
    row: dict[str, Any] = {
        "case": answer["case"],
        "kind": kind,
        "robot": answer.get("robot", "leg"),
        "severity": answer["severity"],
        "truth": "+".join(claim.name for claim in truth) or "nothing",
        "truth_joints": ",".join(truth[0].joints) if len(truth) == 1 else "",
        "verdict": verdict.verdict,
        "claim": first.name if first else verdict.verdict,
        "claim_joints": ",".join(first.joints) if first else "",
        "confidence": first.confidence if first else None,
    }
    right = first is not None and any(first.same(claim) for claim in truth)
    named = first is not None and any(first.name == claim.name for claim in truth)
    candidates = claims if verdict.verdict == "ambiguous" else claims[:1]
    in_class = any(claim.same(one) for claim in candidates for one in truth)
    row["detected"] = verdict.verdict in ("named", "ambiguous", "unknown") if kind != "null" else None
    row["alarm"] = verdict.verdict in ("named", "ambiguous", "unknown") if kind == "null" else None
    row["false_name"] = bool(claims) if kind == "null" else None
    row["unknown_right"] = verdict.verdict == "unknown" if kind == "outsider" else None
    row["named_right"] = named if hidden else None
    row["exact"] = right if hidden else None
    row["class"] = in_class if hidden else None
    row["top3"] = any(one.same(claim) for one in verdict.ranking[:3] for claim in truth) if hidden else None
    local = [claim for claim in truth if claim.joints and first is not None and claim.name == first.name]
    row["joint"] = first.joints == local[0].joints if local and first is not None else None
    found = [any(one.same(claim) for one in claims) for claim in truth]
    named_all = verdict.verdict == "named" and all(found)
    row["both"] = named_all if kind == "pair" else None
    row["one"] = any(found) if kind == "pair" else None
    invented = any(all(claim.name != one.name for one in truth) for claim in claims)
    row["extra"] = verdict.verdict == "named" and right and invented if hidden else None
    row["right"] = right if first is not None and first.confidence is not None else None
    confident = [claim for claim in claims if (claim.confidence or 0.0) > CONFIDENT]
    row["confident_wrong"] = any(not any(claim.same(one) for one in truth) for claim in confident)
    row.update(_sizes(truth, claims))
    row["closure"] = closure(verdict.gap or {})
    row["oracle_closure"] = None if oracle is None else oracle_closure(verdict.gap or {}, oracle.get("gap") or {})
    row["explained"] = first.gain if first is not None else 0.0
    row["black_box"] = verdict.black_box
    row["cannot_tell"] = verdict.cannot_tell
    row["processor_seconds"] = verdict.processor_seconds
    row["returns"] = returns_error(verdict.returns, actual)
    return row


def oracle_closure(gap: Mapping[str, Mapping[str, float]], best: Mapping[str, Mapping[str, float]]) -> float | None:
    """Share of the oracle's improvement on unseen runs that a verdict's model has.

    Relative improvements are summed over the channels that both have, so that channels in which nothing was to be
    gained weigh nothing.

    Args:
        gap: of a verdict, by channel `before` and `after`.
        best: the same under a model that knows which effects are there.

    Returns:
        1 where both close the same; None where the oracle improves less than 1 % on average.
    """
    channels = [name for name in gap if name in best and best[name]["before"] > 0]
    gained = sum(1 - gap[name]["after"] / gap[name]["before"] for name in channels)
    possible = sum(1 - best[name]["after"] / best[name]["before"] for name in channels)
    return float(gained / possible) if channels and possible > 0.01 * len(channels) else None


def returns_error(returns: Mapping[str, Any] | None, actual: float | None) -> dict[str, float] | None:
    """How far the returns of a policy that a verdict predicts, `before` and `after`, are from the `actual` one."""
    if not returns or actual is None:
        return None
    before, after = ((returns.get(label) or {}).get("mean") for label in ("before", "after"))
    if before is None or after is None:
        return None
    return {"actual": actual, "before": abs(float(before) - actual), "after": abs(float(after) - actual)}


def _sizes(truth: Sequence[Claim], claims: Sequence[Claim]) -> dict[str, Any]:
    """Of the first claim that is right and has a size: whether its interval holds the truth, and the ratio of both."""
    for claim in claims:
        for one in truth:
            if claim.same(one) and claim.size is not None and one.size:
                covered = None if claim.interval is None else claim.interval[0] <= one.size <= claim.interval[1]
                return {"size": one.size, "claimed_size": claim.size, "size_ratio": claim.size / one.size} | {
                    "covered": covered
                }
    return {"size": None, "claimed_size": None, "size_ratio": None, "covered": None}


def closure(gap: Mapping[str, Mapping[str, float]]) -> float | None:
    """Share (before - after)/(before - floor) of the gap that was closed, mean over channels; None without a gap."""
    shares = [
        (channel["before"] - channel["after"]) / (channel["before"] - channel["floor"])
        for channel in gap.values()
        if isinstance(channel, Mapping)
        and all(isinstance(channel.get(key), int | float) for key in ("before", "after", "floor"))
        and channel["before"] > channel["floor"]
    ]
    return float(np.clip(np.mean(shares), -1.0, 1.0)) if shares else None


def wilson(count: int, of: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's 95 % interval of a rate (Wilson 1927): count successes of `of` trials."""
    if of == 0:
        return 0.0, 1.0
    share, spread = count / of, z * z / of
    middle = (share + spread / 2) / (1 + spread)
    half = z * math.sqrt(share * (1 - share) / of + spread / (4 * of)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def rate(values: Sequence[bool | None]) -> dict[str, Any] | None:
    """Share of true values among those that are not None, with its interval; None without any."""
    asked = [bool(value) for value in values if value is not None]
    if not asked:
        return None
    low, high = wilson(sum(asked), len(asked))
    return {"value": sum(asked) / len(asked), "low": low, "high": high, "count": sum(asked), "of": len(asked)}


RATES: dict[str, tuple[str, tuple[str, ...]]] = {
    "false_alarms": ("alarm", ("null",)),
    "false_names": ("false_name", ("null",)),
    "top1_name": ("named_right", ("single",)),
    "top1_exact": ("exact", ("single",)),
    "top1_class": ("class", ("single",)),
    "top3_exact": ("top3", ("single",)),
    "joint_localisation": ("joint", ("single", "pair", "poor")),
    "detection": ("detected", ("single",)),
    "extra_names": ("extra", ("single", "poor")),
    "pairs_both": ("both", ("pair",)),
    "pairs_one": ("one", ("pair",)),
    "outsiders_unknown": ("unknown_right", ("outsider",)),
    "poor_class": ("class", ("poor",)),
    "confident_wrong": ("confident_wrong", ("single", "pair", "null", "outsider", "poor")),
    "size_coverage": ("covered", ("single", "pair", "poor")),
}
"""Rates of a summary: the entry of a case's score, and the kinds of cases that count."""

CLEAR_RATES: Mapping[str, str] = {
    "clear_top1_exact": "exact",
    "clear_top1_class": "class",
    "clear_top3_exact": "top3",
    "clear_joint": "joint",
}
"""Rates of single effects that are moderate or strong, seen by a rich excitation: the entry of a case's score."""


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Rates with Wilson's intervals, calibration, gap closure, by severity too; other figures with bootstrap's."""
    summary: dict[str, Any] = {"cases": len(rows), "failed": sum(row["verdict"] == MISSING for row in rows)}
    for name, (entry, kinds) in RATES.items():
        summary[name] = rate([row[entry] for row in rows if row["kind"] in kinds])
    clear = [row for row in rows if row["kind"] == "single" and row["severity"] in ("moderate", "strong")]
    for name, entry in CLEAR_RATES.items():
        summary[name] = rate([row[entry] for row in clear])
    summary["dte_named"] = {
        severity: rate([row["exact"] for row in rows if row["truth"] == "dte" and row["severity"] == severity])
        for severity in ("mild", "moderate", "strong")
    }
    for severity in ("mild", "moderate", "strong"):
        of = [row for row in rows if row["severity"] == severity and row["kind"] == "single"]
        summary[f"by_severity.{severity}"] = {
            name: rate([row[entry] for row in of])
            for name, entry in (("detection", "detected"), ("top1_exact", "exact"), ("top1_class", "class"))
        }
    stated = [(row["confidence"], row["right"]) for row in rows if row["right"] is not None]
    summary["calibration"] = calibration([c for c, _ in stated], [r for _, r in stated])
    closed = [row["closure"] for row in rows if row["closure"] is not None and row["verdict"] in ("named", "ambiguous")]
    summary["gap_closure_median"] = median(closed)
    told = [row["oracle_closure"] for row in rows if row["kind"] in ("single", "pair")]
    summary["oracle_closure_median"] = median([value for value in told if value is not None])
    hidden = [row for row in rows if row["kind"] in ("single", "pair", "outsider")]
    for entry in ("explained", "black_box"):
        summary[f"{entry}_median"] = median([row[entry] for row in hidden if row[entry] is not None])
    returned = [row["returns"] for row in rows if row["returns"] is not None]
    for label in ("before", "after"):
        summary[f"return_error_{label}_median"] = median([values[label] for values in returned])
    summary["processor_seconds_median"] = median([row["processor_seconds"] for row in rows if row["processor_seconds"]])
    ratios = [row["size_ratio"] for row in rows if row["size_ratio"] is not None]
    summary["size_ratio_median"] = median(ratios)
    return summary


def median(values: Sequence[float], resamples: int = 1000) -> dict[str, Any] | None:
    """Median with its 95 % bootstrap interval over cases; None without any."""
    if not len(values):
        return None
    array = np.asarray(values, dtype=float)
    rng = np.random.default_rng(len(array))
    draws = np.median(array[rng.integers(len(array), size=(resamples, len(array)))], axis=1)
    low, high = np.quantile(draws, [0.025, 0.975])
    return {"value": float(np.median(array)), "low": float(low), "high": float(high), "of": len(array)}


def calibration(confidence: Sequence[float], right: Sequence[bool], bins: int = 5) -> dict[str, Any]:
    """How far stated confidence can be trusted.

    Returns:
        `ece`, the mean over claims of |confidence - share right| of their bin; `ece_interval`, its 95 % bootstrap
        interval; `brier`, the mean squared error of the
        confidence; `reliability`, per bin that holds claims: mean confidence, share right, number. None and an
        empty list without claims.
    """
    if not len(confidence):
        return {"ece": None, "ece_interval": None, "brier": None, "reliability": [], "claims": 0}
    stated, truth = np.asarray(confidence, dtype=float), np.asarray(right, dtype=float)
    place = np.minimum((stated * bins).astype(int), bins - 1)
    table = [[float(stated[place == b].mean()), float(truth[place == b].mean()), int((place == b).sum())]
             for b in range(bins) if (place == b).any()]  # fmt: skip
    ece = _calibration_error(stated, truth, bins)
    draws = np.random.default_rng(len(stated)).integers(len(stated), size=(500, len(stated)))
    low, high = np.quantile([_calibration_error(stated[draw], truth[draw], bins) for draw in draws], [0.025, 0.975])
    brier = float(((stated - truth) ** 2).mean())
    interval = [float(low), float(high)]
    return {"ece": ece, "ece_interval": interval, "brier": brier, "reliability": table, "claims": len(stated)}


def _calibration_error(stated: np.ndarray, truth: np.ndarray, bins: int) -> float:
    """Mean over claims of |confidence - share right| of their bin."""
    place = np.minimum((stated * bins).astype(int), bins - 1)
    apart = [(place == b).sum() * abs(stated[place == b].mean() - truth[place == b].mean()) for b in np.unique(place)]
    return float(sum(apart) / len(stated))


def confusion(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str], np.ndarray]:
    """Counts of claims: rows of the truth, columns of the first claim or, without one, the verdict.

    Returns:
        Names of the rows, names of the columns, [row, column] counts. Cases with two hidden effects count in both rows.
    """
    counts: dict[tuple[str, str], int] = {}
    for row in rows:
        for truth in row["truth"].split("+"):
            counts[truth, row["claim"]] = counts.get((truth, row["claim"]), 0) + 1
    truths = sorted({truth for truth, _ in counts}, key=lambda name: (name == "nothing", name))
    claims = sorted({claim for _, claim in counts}, key=lambda name: (name in (*VERDICTS, MISSING), name))
    table = np.array([[counts.get((truth, claim), 0) for claim in claims] for truth in truths], dtype=int)
    return truths, claims, table.reshape(len(truths), len(claims))


def random_name(answer: Mapping[str, Any], names: Sequence[str], rng: np.random.Generator) -> Verdict:
    """Baseline: three effects drawn blindly, the first named everywhere or in one joint with equal chance."""
    drawn = rng.choice(len(names), 3, replace=False)
    claims = tuple(
        Claim(str(names[i]), () if rng.random() < 0.5 else (str(rng.choice(LEG_JOINTS)),), confidence=1 / len(names))
        for i in drawn.tolist()
    )
    return Verdict("named", claims[:1], claims)


def by_robot(rows: Sequence[Mapping[str, Any]]) -> tuple[list[Mapping[str, Any]], list[Mapping[str, Any]]]:
    """Cases of the leg, and cases of the whole robot, which are reported apart."""
    whole = [row for row in rows if row["robot"] == "op3"]
    return [row for row in rows if row["robot"] != "op3"], whole


def score_ranking(verdict: Verdict) -> Verdict | None:
    """Baseline: the effect with the largest statistic of the score test; None where the ranking has no statistics."""
    tested = sorted((claim for claim in verdict.ranking if claim.score is not None), key=lambda claim: -claim.score)  # type: ignore[operator]
    return Verdict("named", (tested[0],), tuple(tested)) if tested else None


def refit_only() -> Verdict:
    """Baseline: the base model is tuned again, and nothing is ever missing."""
    return Verdict("nothing_missing")
