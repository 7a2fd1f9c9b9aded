"""A bench of many cases: the mix, the sealed answers, and the diagnosis as another process."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from op3.stand_in.cases import DATA_FOLDER, SEAL_FILE, TEST_SEEDS, Case, draw_case, make_case, seal, write_answer
from op3.stand_in.children import run_command
from op3.stand_in.hidden import BASES, CATALOGUE, OUTSIDERS, SEVERITIES

VERDICT_FILE = "verdict.yaml"
LOG_FILE = "diagnose.log"
ORACLE_FILE = "run/oracle.yaml"
WORLD_FILE = "world.yaml"
SETS: tuple[str, ...] = ("development", "test")
"""Sets of cases with seeds of their own; thresholds are chosen on the first, the second is opened once a release."""


_WHOLE = (
    "single",
    "single",
    "null",
    "single",
    "single",
    "pair",
    "single",
    "single",
    "null",
    "single",
    "single",
    "outsider",
)
"""Kinds of the cases of the whole robot, in turn."""


def draw_mix(mix: Mapping[str, Any], which: str = "development", first_seed: int = 0) -> list[Case]:
    """The cases of a bench, each with its own seed, kinds interleaved.

    Args:
        mix: `singles`, cases per effect and severity, by severity; `effects`, which (None: all of the catalogue);
            `nulls`, `pairs`, `outsiders`, `poor`, numbers of cases; `op3`, cases of the whole robot, of which two
            thirds hide one effect, a sixth none, and the others a pair or an outsider.
        which: "development" or "test".
        first_seed: of the set.
    """
    if which not in SETS:
        raise ValueError(f"there is no set of cases {which!r}; choose {' or '.join(SETS)}")
    seed = first_seed + (TEST_SEEDS if which == "test" else 0)
    if not 0 <= first_seed < TEST_SEEDS:
        raise ValueError(f"first_seed must be at least 0 and below {TEST_SEEDS}, got {first_seed}")
    levels = list(SEVERITIES)
    plan: list[tuple[str, str, str | None]] = []
    for severity, count in mix["singles"].items():
        plan += [("single", severity, name) for name in mix.get("effects") or CATALOGUE for _ in range(count)]
    plan += [("null", "moderate", None)] * mix["nulls"]
    plan += [("pair", levels[1 + i % 2], None) for i in range(mix["pairs"])]
    plan += [("outsider", levels[1 + i % 2], OUTSIDERS[i % len(OUTSIDERS)]) for i in range(mix["outsiders"])]
    plan += [("poor", levels[1 + i % 2], None) for i in range(mix["poor"])]
    cases = [draw_case(seed + i, kind, severity, name) for i, (kind, severity, name) in enumerate(plan)]
    whole = [_WHOLE[i % len(_WHOLE)] for i in range(mix.get("op3", 0))]
    for i, kind in enumerate(whole):
        # every third single is one of which a whole world can be made, so that a policy can be run in it
        name = list(BASES)[i // 3 % len(BASES)] if kind == "single" and i % 3 == 0 else None
        cases.append(draw_case(seed + len(plan) + i, kind, levels[1 + i % 2], name, robot="op3"))
    # the names are hashes of the seeds: in their order a run that is stopped early has seen a fair sample
    return sorted(cases, key=lambda case: case.name)


def commit(cases: Sequence[Case], answers: str | Path) -> Path:
    """Write and seal all answers; those sealed before must be the same to the byte.

    Raises:
        ValueError: if the folder holds answers of another bench.
    """
    answers = Path(answers)
    for case in cases:
        write_answer(case, answers)
    sealed = answers / SEAL_FILE
    before = sealed.read_text(encoding="utf-8") if sealed.is_file() else None
    if before is not None and {line[66:] for line in before.splitlines()} != {f"{case.name}.yaml" for case in cases}:
        raise ValueError(f"{answers} holds the answers of another bench; take another folder")
    path = seal(answers)
    if before is not None and path.read_text(encoding="utf-8") != before:
        path.write_text(before, encoding="utf-8")
        raise ValueError(f"an answer in {answers} is not the one that was sealed; take another folder")
    return path


def run_case(
    case: Case, folder: str | Path, answers: str | Path, command: Sequence[str], timeout: float, keep_data: bool
) -> Path | None:
    """Record one case, let another process diagnose it, and give its verdict's path; None if it wrote none.

    Args:
        case: what is hidden.
        folder: of the cases. A verdict that is there already is taken as it is.
        answers: folder of the answers.
        command: of the diagnosis; `{data}`, `{model}` and `{run}` stand for the logs, the base model and where
            the verdict is to be written.
        timeout: after which the diagnosis is stopped [s].
        keep_data: whether the logs stay on the disk afterwards.
    """
    place = Path(folder) / case.name
    run = place / "run"
    verdict = run / VERDICT_FILE
    if verdict.is_file():
        return verdict
    make_case(case, folder, answers)
    run.mkdir(parents=True, exist_ok=True)
    filled = [part.format(data=place / DATA_FOLDER, model=case.base, run=run) for part in command]
    run_command(filled, place / LOG_FILE, timeout)
    if not keep_data:
        shutil.rmtree(place / DATA_FOLDER)
    return verdict if verdict.is_file() else None


def run_beside(
    case: Case,
    folder: str | Path,
    answers: str | Path,
    command: Sequence[str],
    result: str,
    timeout: float,
    keep_data: bool,
) -> Path | None:
    """Let a further process work on a case's logs: a baseline, or one to which the answer is told.

    It is to be called after all verdicts have been written.

    Args:
        case: what is hidden.
        folder: of the cases. What is there already is taken as it is.
        answers: folder of the answers.
        command: `{data}`, `{model}`, `{run}` as for `run_case`, `{answer}`, the file of the answer, and `{beside}`,
            the folder of `result`.
        result: file, in the case's folder, that the process is to write.
        timeout: after which it is stopped [s].
        keep_data: whether the logs stay on the disk afterwards.

    Returns:
        Path of the result, None if none was written.
    """
    place = Path(folder) / case.name
    path = place / result
    if path.is_file():
        return path
    if not (place / DATA_FOLDER).is_dir():
        make_case(case, folder, answers)
    path.parent.mkdir(parents=True, exist_ok=True)
    names = {
        "data": place / DATA_FOLDER,
        "model": case.base,
        "run": place / "run",
        "answer": Path(answers) / f"{case.name}.yaml",
        "beside": path.parent,
    }
    run_command([part.format(**names) for part in command], path.with_suffix(".log"), timeout)
    if not keep_data:
        shutil.rmtree(place / DATA_FOLDER)
    return path if path.is_file() else None


def run_policy(case: Case, folder: str | Path, command: Sequence[str], timeout: float) -> Path | None:
    """Let another process run a policy on the whole robot with its hidden truth; to be called after all verdicts.

    The robot that walks about has what a world holds: base parameters, and of the hidden effects those of `BASES`.

    Args:
        case: of the whole robot.
        folder: of the cases. Episodes that are there already are taken as they are.
        command: `{world}` and `{run}` stand for a file of the truth and for where the episodes go.
        timeout: after which it is stopped [s].

    Returns:
        Folder of the episodes; None where the truth is more than a world, or the process failed.
    """
    if case.robot != "op3" or any(hidden.name not in BASES for hidden in case.truth.hidden):
        return None
    episodes = Path(folder) / case.name / "episodes"
    if not episodes.is_dir():
        episodes.mkdir(parents=True)
        world = case.truth.world.save(episodes / WORLD_FILE)
        run_command([part.format(world=world, run=episodes) for part in command], episodes / "policy.log", timeout)
    return episodes if any(episodes.glob("*/metadata.yaml")) else None


def run_all(
    cases: Sequence[Case],
    folder: str | Path,
    answers: str | Path,
    command: Sequence[str],
    *,
    timeout: float = 1800.0,
    keep_data: bool = True,
    whole_robot: Sequence[str] = (),
    say: Callable[[str], None] = print,
) -> dict[str, Path | None]:
    """Run every case that has no verdict yet; one line per case says how far it is.

    Arguments are those of `run_case`; `whole_robot` are parts of the command for cases of the whole robot besides.

    Returns:
        Path of the verdict by case name, None where the diagnosis wrote none.
    """
    found: dict[str, Path | None] = {}
    begin, done = time.monotonic(), 0
    for number, case in enumerate(cases, start=1):
        known = (Path(folder) / case.name / "run" / VERDICT_FILE).is_file()
        own = [*command, *(whole_robot if case.robot == "op3" else ())]
        found[case.name] = run_case(case, folder, answers, own, timeout, keep_data)
        if known:
            continue
        done += 1
        each = (time.monotonic() - begin) / done
        outcome = "" if found[case.name] else f"; no verdict, see {Path(folder) / case.name / LOG_FILE}"
        say(f"case {number}/{len(cases)}, {each:.0f} s each, {each * (len(cases) - number) / 60:.0f} min left{outcome}")
    return found
