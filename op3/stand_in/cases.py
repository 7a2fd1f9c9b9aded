"""Cases of the hidden-effect bench: drawn from a seed, recorded, and sealed before the logs are diagnosed.

`draw_case` chooses the hidden effects; `make_case` writes the logs for the diagnosis and, in another folder, the
answer, which the diagnosis must not read. `seal` writes the SHA-256 of all answers into one file, which is published
first. Seeds below `TEST_SEEDS` are for development, the others for the test.
"""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from numpy.typing import NDArray

from op3.motions import Excitation
from op3.rollout import Rollout
from op3.scenes.scene import Scene
from op3.stand_in.hidden import ALIAS_PAIRS, BASES, CATALOGUE, KINDS, OUTSIDERS, SEVERITIES, Hidden
from op3.stand_in.play import play
from op3.stand_in.stand_in_robot import StandIn
from op3.stand_in.suites import SETTINGS, Setting
from op3.stand_in.world import BENCH_RANGES, HiddenWorld, Ranges, check_seed

CASE_KINDS: tuple[str, ...] = ("single", "pair", "null", "outsider", "poor")
"""One catalogue effect; two; none; an out-of-catalogue effect; one effect with a poor excitation."""

TEST_SEEDS = 1_000_000
"""First seed of the test set."""

PLAIN_BASE = "paper"
"""The model from which most diagnoses start."""

DATA_FOLDER = "data"
CASE_FILE = "case.yaml"
SEAL_FILE = "answers.sha256"

OTHER_FORM_SHARE = 1 / 3
"""Share of cases in which the hidden effect has an unusual form."""

LESS_SHARE = 0.3
"""Share of further cases in which neither the robot nor the base model has one of the effects in `BASES`, so that the
base model does not reveal the answer."""

MIRROR_SHARE = 0.25
"""Share of effects of single joints that are in a joint and its mirror partner."""

LOADED = 0.08
"""A joint that gravity can load with at least this torque counts as loaded [N m]."""

PAUSE = 6.0
"""Time between runs [s]."""

WARM_UP = 240.0
"""Time for which the robot works before its warm runs [s]."""

MORNING = datetime.datetime(2026, 1, 15, 9, 0)
"""When the first run begins."""

Array = NDArray[np.float64]
Places = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class Case:
    """The hidden effects of one case, and the inputs of its diagnosis.

    Attributes:
        name: name of the case's folder, which does not reveal the answer.
        seed: seed of everything in the case.
        kind: one of `CASE_KINDS`.
        severity: one of `SEVERITIES`, None where nothing is hidden.
        base: model that the diagnosis starts from; "null": built from the robot's servo files.
        world: numbers of the robot, with those of `hidden` that are part of a world.
        hidden: the hidden effects.
        joints: joints of the robot.
        robot: key of `SETTINGS`.
    """

    name: str
    seed: int
    kind: str
    severity: str | None
    base: str
    world: HiddenWorld
    hidden: tuple[Hidden, ...]
    joints: tuple[str, ...]
    robot: str

    def answer(self) -> dict[str, Any]:
        """The sealed answer, as plain values."""
        effects = [
            {
                "name": hidden.name,
                "joints": list(hidden.joints) or list(self.joints),
                "shared": not hidden.joints,
                "size": hidden.size,
                "unit": KINDS[hidden.name].unit,
                "meaning": KINDS[hidden.name].meaning,
                "form": hidden.form,
                "shape": list(hidden.shape),
                "in_catalogue": not KINDS[hidden.name].outsider,
            }
            for hidden in self.hidden
        ]
        fields = ("seed", "kind", "robot", "severity", "base")
        told = {"case": self.name, **{name: getattr(self, name) for name in fields}}
        return {**told, "effects": effects, "world": dataclasses.asdict(self.world)}


def draw_case(
    seed: int,
    kind: str = "single",
    severity: str = "clear",
    effect: str | None = None,
    ranges: Ranges = BENCH_RANGES,
    *,
    robot: str,
) -> Case:
    """Choose the hidden effects of one case.

    Args:
        seed: seed of everything in the case.
        kind: one of `CASE_KINDS`.
        severity: one of `SEVERITIES`; null cases have none.
        effect: hide this one (singles, outsiders, poor cases, and the first of a pair); drawn if None.
        ranges: ranges of the robots' parameters.
        robot: key of `SETTINGS`.
    """
    for name, value, known in (
        ("robot", robot, SETTINGS),
        ("kind", kind, CASE_KINDS),
        ("severity", severity, SEVERITIES),
    ):
        if value not in known:
            raise ValueError(f"there is no {name} {value!r} of a case; choose {', '.join(known)}")
    check_seed("the seed of a case", seed)
    rng = np.random.default_rng([int(seed), 40])
    joints, places, mirror, law = _places(robot)
    bases = BASES if law == PLAIN_BASE else {}
    names = _names(rng, kind, effect, bases)
    hidden = tuple(_hide(rng, name, SEVERITIES[severity], places, mirror) for name in names)
    missing = next((name for name in names if name in bases), None)
    if missing is None and rng.random() < LESS_SHARE and bases:
        missing = str(rng.choice(list(bases)))
    world = HiddenWorld.random(int(seed), ranges)
    return Case(
        name=f"case_{hashlib.sha256(f'op3 {seed}'.encode()).hexdigest()[:10]}",
        seed=int(seed),
        kind=kind,
        severity=None if kind == "null" else severity,
        base=law or "null" if missing is None else bases[missing],
        world=_without(world, missing, {one.name: one for one in hidden}),
        hidden=hidden,
        joints=joints,
        robot=robot,
    )


def _without(world: HiddenWorld, missing: str | None, hidden: dict[str, Hidden]) -> HiddenWorld:
    """The world whose robot lacks one of `BASES`, or has as much of it as is hidden."""
    one = hidden.get(missing or "")
    if missing == "dte":
        world = world.replace(backward_efficiency=1 / (1 + (one.size if one else 0.0)))
        return world.replace(loss_form=one.form) if one else world
    if missing == "stribeck":
        world = world.replace(static_friction_excess=one.size if one else 0.0)
        return world.replace(fade_form=one.form) if one else world
    return world.replace(command_latency=0.0) if missing == "latency" else world


def _names(rng: np.random.Generator, kind: str, effect: str | None, bases: Mapping[str, str]) -> tuple[str, ...]:
    """Effects that can be hidden, by name; effects missing in base models only if there are such base models."""
    if kind == "null":
        return ()
    catalogue = [name for name in CATALOGUE if name in bases or name not in BASES]
    pool = OUTSIDERS if kind == "outsider" else catalogue
    if effect is not None and effect not in pool:
        raise ValueError(f"a case of kind {kind} cannot hide {effect!r}; choose {', '.join(pool)}")
    first = effect or str(rng.choice(pool))
    if kind != "pair":
        return (first,)
    alike = [pair for pair in ALIAS_PAIRS if set(pair) <= set(catalogue)]
    partners = [b if a == first else a for a, b in alike if first in (a, b)]
    if effect is None and rng.random() < 0.5:
        first, second = alike[rng.integers(len(alike))]
    elif effect is not None and partners and rng.random() < 0.5:
        second = str(rng.choice(partners))
    else:
        second = str(rng.choice([name for name in catalogue if name != first]))
    if first in BASES and second in BASES:  # a base model lacks one effect at most
        second = str(rng.choice([name for name in catalogue if name not in BASES]))
    return first, second


def _hide(rng: np.random.Generator, name: str, factor: float, places: Places, mirror: Mapping[str, str]) -> Hidden:
    """One effect with this severity, in drawn joints and a drawn form."""
    kind = KINDS[name]
    joints: tuple[str, ...] = ()
    if kind.place != "all":
        joints = (str(rng.choice(places[kind.place])),)
        partner = mirror.get(joints[0], joints[0])
        if not kind.signed and partner != joints[0] and partner in places["any"] and rng.random() < MIRROR_SHARE:
            joints = tuple(sorted((joints[0], partner), key=places["any"].index))
    strength = rng.uniform(0.9, 1.1)
    sign = -1.0 if kind.signed and rng.random() < 0.5 else 1.0
    shape = tuple(float(x) for x in rng.random(3))
    usual = rng.random() >= OTHER_FORM_SHARE or len(kind.forms) == 1
    form = kind.forms[0] if usual else str(rng.choice(kind.forms[1:]))
    return Hidden(name, sign * kind.size * strength * factor, joints, form, shape)


@cache
def _places(robot: str) -> tuple[tuple[str, ...], Places, dict[str, str], str | None]:
    """Joints of a robot, and those where effects can sit: any, loaded by gravity, far from the base; partners in the
    mirror, and the model that it starts from."""
    scene = SETTINGS[robot].scene()
    joints = tuple(str(joint.name) for joint in scene.joints)
    load, depth = _load_and_depth(scene)
    loaded = tuple(name for name, torque in zip(joints, load, strict=True) if torque >= LOADED)
    far = tuple(name for name, links in zip(joints, depth, strict=True) if links >= min(3, max(depth)))
    known = scene.robot_file
    return joints, {"any": joints, "loaded": loaded or joints, "far": far}, known.partners, known.file.law


def _load_and_depth(scene: Scene) -> tuple[Array, list[int]]:
    """Largest torque of gravity on each joint [joint] in N m, the robot turned any way, and joints up to the base."""
    model = scene.compile(visual=False)
    data, ids = mujoco.MjData(model), [model.joint(name).id for name in scene.joint_names]
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    bodies = model.jnt_bodyid[ids]
    lever = np.cross(data.subtree_com[bodies] - data.xanchor[ids], data.xaxis[ids])
    load = model.body_subtreemass[bodies] * np.linalg.norm(lever, axis=1) * np.linalg.norm(model.opt.gravity)
    depth = []
    for body in bodies:
        above = [body]
        while above[-1]:
            above.append(model.body_parentid[above[-1]])
        depth.append(sum(1 for one in above if one in bodies))
    return load, depth


def record_case(case: Case, runs: Sequence[Excitation] | None = None) -> Iterator[Rollout]:
    """Every run of a case in chronological order; the same seed gives the same bytes.

    Args:
        case: case from `draw_case`.
        runs: runs that the robot performs; None: the suite of its setting.
    """
    setting = SETTINGS[case.robot]
    if runs is None:
        runs = (setting.poor if case.kind == "poor" else setting.rich)(case.seed)
    robot = StandIn(case.world.replace(hidden=case.hidden), setting.scene(), seed=case.seed)
    day = _day(runs, setting, case)
    for number, (run, (day_time, temperature)) in enumerate(zip(runs, day, strict=True)):
        begin = MORNING + datetime.timedelta(seconds=float(day_time))
        extra = {"robot_id": case.name, "tilt": [float(angle) for angle in run.tilt]}
        metadata = {**setting.metadata(), "seed": None, "date": begin.isoformat(timespec="seconds"), "extra": extra}
        placed = {"tilt": run.tilt, "day_time": day_time, "temperature": temperature}
        options = {"still": False, "settle": setting.settle, "pushes": getattr(run, "pushes", ()), "metadata": metadata}
        recording = f"{case.name}/{number:02d}"
        yield play(robot, run.motion, run.p_gain, run.d_gain, recording=recording, **options, **placed)


def _day(runs: Sequence[Excitation], setting: Setting, case: Case) -> Iterator[tuple[float, float]]:
    """When each run begins [s], and how warm the servos are then [C]."""
    rng = np.random.default_rng([case.seed, 30])
    begin, ambient, warm = 0.0, case.world.ambient_temperature, False
    for run in runs:
        begin += WARM_UP if run.warm and not warm else 0.0
        warm = run.warm
        yield begin, ambient + (rng.uniform(28, 36) if warm else 5 * (1 - np.exp(-begin / 120)))
        begin += float(run.motion.time[-1]) + setting.settle + PAUSE


def make_case(case: Case, folder: str | Path, answers: str | Path) -> Path:
    """Record a case: logs and initial model for the diagnosis, and the answer in another folder.

    Args:
        case: case from `draw_case`.
        folder: `<folder>/<case.name>/data/` gets one rollout folder per run, `case.yaml` beside it the base model.
        answers: folder for the answers, `<answers>/<case.name>.yaml`; an answer that is there already must be the
            same to the byte.

    Returns:
        The case's folder.
    """
    place = Path(folder) / case.name
    write_answer(case, answers)
    for number, log in enumerate(record_case(case)):
        log.save(place / DATA_FOLDER / f"{number:02d}_{log.metadata.motion}", overwrite=True)
    given = {"case": case.name, "robot": case.robot, "base": case.base}
    (place / CASE_FILE).write_text(yaml.safe_dump(given, sort_keys=False), encoding="utf-8")
    return place


def write_answer(case: Case, answers: str | Path) -> Path:
    """Write `<answers>/<case.name>.yaml`; an existing file must have the same bytes."""
    path = Path(answers) / f"{case.name}.yaml"
    content = answer_bytes(case)
    if path.is_file() and path.read_bytes() != content:
        raise ValueError(f"{path} contains a different answer; choose another folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def answer_bytes(case: Case) -> bytes:
    """The bytes of the answer's file."""
    return yaml.safe_dump(case.answer(), sort_keys=False).encode()


def seal(answers: str | Path) -> Path:
    """Write the SHA-256 of every answer in a folder, as `sha256sum` does, to `answers.sha256` in it."""
    answers = Path(answers)
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}" for path in sorted(answers.glob("*.yaml"))]
    path = answers / SEAL_FILE
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def commit(cases: Sequence[Case], answers: str | Path) -> Path:
    """Write and seal all answers; answers sealed before must have the same bytes.

    Raises:
        ValueError: if the folder contains answers of another bench.
    """
    answers = Path(answers)
    for case in cases:
        write_answer(case, answers)
    sealed = answers / SEAL_FILE
    before = sealed.read_text(encoding="utf-8") if sealed.is_file() else None
    if before is not None and {line[66:] for line in before.splitlines()} != {f"{case.name}.yaml" for case in cases}:
        raise ValueError(f"{answers} contains the answers of another bench; choose another folder")
    path = seal(answers)
    if before is not None and path.read_text(encoding="utf-8") != before:
        path.write_text(before, encoding="utf-8")
        raise ValueError(f"an answer in {answers} differs from the sealed one; choose another folder")
    return path


def open_answers(answers: str | Path, commitment: str | Path | None = None) -> dict[str, dict[str, Any]]:
    """Read answers and check their hashes against the published ones.

    Args:
        answers: folder of the answers.
        commitment: the published file; None: the one in the folder.

    Returns:
        Answers by case name.

    Raises:
        ValueError: if an answer was changed, added or removed after sealing.
    """
    answers = Path(answers)
    commitment = Path(commitment or answers / SEAL_FILE)
    if not commitment.is_file():
        raise FileNotFoundError(f"there is no {commitment}; seal the answers before diagnosing")
    lines = commitment.read_text(encoding="utf-8").splitlines()
    sealed = {line[66:]: line[:64] for line in lines if line}
    found = {path.name: path.read_bytes() for path in sorted(answers.glob("*.yaml"))}
    for name in sorted(set(sealed) ^ set(found)):
        raise ValueError(f"{name} is {'sealed but missing' if name in sealed else 'present but was never sealed'}")
    opened = {}
    for name, content in found.items():
        if hashlib.sha256(content).hexdigest() != sealed[name]:
            raise ValueError(f"{answers / name} was changed after it had been sealed")
        opened[name.removesuffix(".yaml")] = yaml.safe_load(content)
    return opened
