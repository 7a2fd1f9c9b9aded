"""Cases of the hidden-effect bench: drawn from a seed, recorded, and sealed before anybody looks at the logs.

`draw_case` decides what is hidden, `make_case` writes the logs that a diagnosis may see and, elsewhere, the answer
that it may not. `seal` writes the SHA-256 of all answers into one file, which is published first. Seeds below
`TEST_SEEDS` are for development, the others for the test; the two never meet.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from op3.robot import JOINTS, LEG_JOINTS, MIRROR, leg_suite, leg_walking, robot_suite, robot_walking
from op3.stand_in.hidden import ALIAS_PAIRS, BASES, CATALOGUE, KINDS, OUTSIDERS, SEVERITIES, Hidden
from op3.stand_in.leg import record_leg
from op3.stand_in.leg_servos import LegTruth
from op3.stand_in.world import World

CASE_KINDS: tuple[str, ...] = ("single", "pair", "null", "outsider", "poor")
"""One catalogue effect; two; none; something no catalogue holds; one effect seen by a poor excitation only."""

ROBOTS: dict[str, tuple[str, ...]] = {"leg": LEG_JOINTS, "op3": JOINTS}
"""Joints of what a case is recorded on: the right leg, or the whole robot, on the stand."""

TEST_SEEDS = 1_000_000
"""First seed of the test set."""

PLAIN_BASE = "paper"
"""The model from which most diagnoses start."""

DATA_FOLDER = "data"
CASE_FILE = "case.yaml"
SEAL_FILE = "answers.sha256"

OTHER_FORM_SHARE = 1 / 3
"""Share of cases in which what is hidden takes another form than usual."""

LESS_SHARE = 0.3
"""Share of cases, beyond those that hide one of `BASES`, whose robot lacks one of them and whose base model too, so
that the base model does not give the answer away."""


@dataclass(frozen=True)
class Case:
    """What is hidden in one case, and what the diagnosis is handed.

    Attributes:
        name: of the case's folder; tells nothing.
        seed: of everything in the case.
        kind: one of `CASE_KINDS`.
        severity: one of `SEVERITIES`, None where nothing is hidden.
        base: model that the diagnosis starts from.
        truth: the leg.
        bare: the same leg with nothing hidden in it.
        robot: one of `ROBOTS`.
    """

    name: str
    seed: int
    kind: str
    severity: str | None
    base: str
    truth: LegTruth
    bare: LegTruth
    robot: str = "leg"

    def answer(self) -> dict[str, Any]:
        """The sealed answer, as plain values."""
        effects = [
            {
                "name": hidden.name,
                "joints": list(hidden.joints) or list(self.truth.joints),
                "shared": not hidden.joints,
                "size": hidden.size,
                "unit": KINDS[hidden.name].unit,
                "meaning": KINDS[hidden.name].meaning,
                "form": hidden.form,
                "shape": list(hidden.shape),
                "in_catalogue": not KINDS[hidden.name].outsider,
            }
            for hidden in self.truth.hidden
        ]
        return {
            "case": self.name,
            "seed": self.seed,
            "kind": self.kind,
            "robot": self.robot,
            "severity": self.severity,
            "base": self.base,
            "effects": effects,
            "gear_form": self.truth.gear_form,
            "fade_form": self.truth.fade_form,
            "world": dataclasses.asdict(self.truth.world),
        }


def draw_case(
    seed: int,
    kind: str = "single",
    severity: str = "moderate",
    effect: str | None = None,
    scale: float = 1.0,
    robot: str = "leg",
) -> Case:
    """Decide what one case hides.

    Args:
        seed: of everything in the case.
        kind: one of `CASE_KINDS`.
        severity: one of `SEVERITIES`; null cases have none.
        effect: hide this one (singles, outsiders, poor cases, and the first of a pair); drawn if None.
        scale: factor on every hidden size, 0 for a leg that differs from this case in nothing else.
        robot: one of `ROBOTS`; on the whole robot, effects of single joints sit in either leg.
    """
    if robot not in ROBOTS:
        raise ValueError(f"there is no robot {robot!r}; choose {', '.join(ROBOTS)}")
    if kind not in CASE_KINDS:
        raise ValueError(f"there is no kind of case {kind!r}; choose {', '.join(CASE_KINDS)}")
    if severity not in SEVERITIES:
        raise ValueError(f"there is no severity {severity!r}; choose {', '.join(SEVERITIES)}")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"the seed of a case must be a whole number of at least 0, got {seed!r}")
    rng = np.random.default_rng([int(seed), 40])
    names = _names(rng, kind, effect)
    hidden = tuple(_hide(rng, name, SEVERITIES[severity] * scale) for name in names)
    if robot == "op3":
        sides = np.random.default_rng([int(seed), 41])
        hidden = tuple(_other_side(one) if one.joints and sides.random() < 0.5 else one for one in hidden)
    world = World.random(int(seed))
    forms: dict[str, Any] = {
        "gear_form": _form(rng, ("power", "m6")),
        "fade_form": _form(rng, ("gaussian", "exponential")),
    }
    missing = next((name for name in names if name in BASES), None)
    if missing is None and rng.random() < LESS_SHARE:
        missing = str(rng.choice(list(BASES)))
    sizes = {one.name: one.size for one in hidden}
    for one in hidden:
        if one.name in ("dte", "stribeck"):
            forms["gear_form" if one.name == "dte" else "fade_form"] = one.form
    return Case(
        name=f"case_{hashlib.sha256(f'op3 {seed}'.encode()).hexdigest()[:10]}",
        seed=int(seed),
        kind=kind,
        severity=None if kind == "null" else severity,
        base=PLAIN_BASE if missing is None else BASES[missing],
        truth=LegTruth(_without(world, missing, sizes), hidden, joints=ROBOTS[robot], **forms),
        bare=LegTruth(_without(world, missing, {}), (), joints=ROBOTS[robot], **forms),
        robot=robot,
    )


def _other_side(hidden: Hidden) -> Hidden:
    """The same effect in the partners of its joints."""
    return dataclasses.replace(hidden, joints=tuple(MIRROR[joint][0] for joint in hidden.joints))


def _without(world: World, missing: str | None, sizes: dict[str, float]) -> World:
    """The world whose robot lacks one of `BASES`, or has as much of it as is hidden."""
    if missing == "dte":
        return world.replace(backward_efficiency=1 / (1 + sizes.get("dte", 0.0)))
    if missing == "stribeck":
        return world.replace(static_friction_excess=sizes.get("stribeck", 0.0))
    if missing == "latency":
        return world.replace(command_latency=sizes.get("latency", 0.0))
    return world


def _names(rng: np.random.Generator, kind: str, effect: str | None) -> tuple[str, ...]:
    """What is hidden, by name."""
    if kind == "null":
        return ()
    pool = OUTSIDERS if kind == "outsider" else CATALOGUE
    if effect is not None and effect not in pool:
        raise ValueError(f"a case of kind {kind} cannot hide {effect!r}; it can hide {', '.join(pool)}")
    first = effect or str(rng.choice(pool))
    if kind != "pair":
        return (first,)
    partners = [b if a == first else a for a, b in ALIAS_PAIRS if first in (a, b)]
    if effect is None and rng.random() < 0.5:
        first, second = ALIAS_PAIRS[rng.integers(len(ALIAS_PAIRS))]
    elif effect is not None and partners and rng.random() < 0.5:
        second = str(rng.choice(partners))
    else:
        second = str(rng.choice([name for name in CATALOGUE if name != first]))
    if first in BASES and second in BASES:  # a base model lacks one effect at most
        second = str(rng.choice([name for name in CATALOGUE if name not in BASES]))
    # a gear is loose or soft in one model of it, not both
    if {first, second} == {"backlash", "compliance"}:
        second = "lugre"
    return first, second


def _hide(rng: np.random.Generator, name: str, factor: float) -> Hidden:
    """One effect of this strength, at a drawn place, in a drawn form."""
    kind = KINDS[name]
    joints = (str(rng.choice(kind.joints)),) if kind.joints else ()
    strength = rng.uniform(0.9, 1.1)
    sign = -1.0 if kind.signed and rng.random() < 0.5 else 1.0
    shape = tuple(float(x) for x in rng.random(3))
    form = _form(rng, kind.forms)
    size = 0.0 if factor == 0 else sign * kind.size(strength * factor)
    return Hidden(name, size, joints, form, shape)


def _form(rng: np.random.Generator, forms: Sequence[str]) -> str:
    usual = rng.random() >= OTHER_FORM_SHARE
    return forms[0] if usual or len(forms) == 1 else str(rng.choice(forms[1:]))


def make_case(case: Case, folder: str | Path, answers: str | Path) -> Path:
    """Record a case: logs and base model for the diagnosis, the answer in another place.

    Args:
        case: from `draw_case`.
        folder: `<folder>/<case.name>/data/` gets one rollout folder per run, `case.yaml` beside it the base model.
        answers: folder for the answers, `<answers>/<case.name>.yaml`; an answer that is there already must be the
            same to the byte.

    Returns:
        The case's folder.
    """
    place = Path(folder) / case.name
    rich, poor = (robot_suite, robot_walking) if case.robot == "op3" else (leg_suite, leg_walking)
    suite = poor(case.seed) if case.kind == "poor" else rich(case.seed)
    write_answer(case, answers)
    for number, log in enumerate(record_leg(case.truth, suite, case.seed, case.name)):
        log.save(place / DATA_FOLDER / f"{number:02d}_{log.metadata.motion}", overwrite=True)
    given = {"case": case.name, "base": case.base}
    (place / CASE_FILE).write_text(yaml.safe_dump(given, sort_keys=False), encoding="utf-8")
    return place


def write_answer(case: Case, answers: str | Path) -> Path:
    """Write `<answers>/<case.name>.yaml`, or check that it is there to the byte."""
    path = Path(answers) / f"{case.name}.yaml"
    content = answer_bytes(case)
    if path.is_file() and path.read_bytes() != content:
        raise ValueError(f"{path} holds another answer; take another folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def answer_bytes(case: Case) -> bytes:
    """The answer's file, to the byte."""
    return yaml.safe_dump(case.answer(), sort_keys=False).encode()


def seal(answers: str | Path) -> Path:
    """Write the SHA-256 of every answer in a folder, as `sha256sum` does, to `answers.sha256` in it."""
    answers = Path(answers)
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" for path in sorted(answers.glob("*.yaml"))]
    path = answers / SEAL_FILE
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def open_answers(answers: str | Path, commitment: str | Path | None = None) -> dict[str, dict[str, Any]]:
    """Read answers whose hashes agree with what was published.

    Args:
        answers: folder of the answers.
        commitment: the published file; None: the one in the folder.

    Returns:
        Answers by case name.

    Raises:
        ValueError: if an answer was changed, added or taken away after sealing.
    """
    answers = Path(answers)
    commitment = Path(commitment or answers / SEAL_FILE)
    if not commitment.is_file():
        raise FileNotFoundError(f"there is no {commitment}; seal the answers before diagnosing")
    lines = commitment.read_text(encoding="utf-8").splitlines()
    sealed = {line[66:]: line[:64] for line in lines if line}
    found = {path.name: path.read_bytes() for path in sorted(answers.glob("*.yaml"))}
    for name in sorted(set(sealed) ^ set(found)):
        raise ValueError(f"{name} is {'sealed but gone' if name in sealed else 'there but was never sealed'}")
    opened = {}
    for name, content in found.items():
        if hashlib.sha256(content).hexdigest() != sealed[name]:
            raise ValueError(f"{answers / name} was changed after it had been sealed")
        opened[name.removesuffix(".yaml")] = yaml.safe_load(content)
    return opened
