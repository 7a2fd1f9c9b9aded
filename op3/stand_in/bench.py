"""A bench of many cases: the mix, the sealed answers, and the diagnosis as another process."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from op3.stand_in.cases import DATA_FOLDER, SEAL_FILE, TEST_SEEDS, Case, draw_case, make_case, seal, write_answer
from op3.stand_in.hidden import CATALOGUE, OUTSIDERS, SEVERITIES
from op3.stand_in.processes import run_command
from op3.stand_in.world import BENCH_RANGES, Ranges

VERDICT_FILE = "verdict.yaml"
LOG_FILE = "diagnose.log"
COST_FILE = "cost.yaml"
SETS: tuple[str, ...] = ("development", "test")
"""Sets of cases with separate seeds; constants are chosen on the first, the second is opened once per release."""


def draw_mix(
    mix: Mapping[str, Any], which: str = "development", first_seed: int = 0, ranges: Ranges = BENCH_RANGES
) -> list[Case]:
    """The cases of a bench, each with its own seed, kinds interleaved.

    Args:
        mix: `robots`, what the cases are recorded on, in turn; `singles`, cases per effect, by severity; `effects`,
            which (None: all of the catalogue); `nulls`, `pairs`, `outsiders`, `poor`, numbers of cases.
        which: "development" or "test".
        first_seed: of the set.
        ranges: of the robots' numbers.
    """
    if which not in SETS:
        raise ValueError(f"there is no set of cases {which!r}; choose {' or '.join(SETS)}")
    if not 0 <= first_seed < TEST_SEEDS:
        raise ValueError(f"first_seed must be at least 0 and below {TEST_SEEDS}, got {first_seed}")
    seed = first_seed + (TEST_SEEDS if which == "test" else 0)
    levels = list(SEVERITIES)
    plan: list[tuple[str, str, str | None]] = []
    for severity, count in mix["singles"].items():
        plan += [("single", severity, name) for name in mix.get("effects") or CATALOGUE for _ in range(count)]
    plan += [("null", "clear", None)] * mix["nulls"]
    plan += [("pair", levels[1 + i % 2], None) for i in range(mix["pairs"])]
    plan += [("outsider", levels[1 + i % 2], OUTSIDERS[i % len(OUTSIDERS)]) for i in range(mix["outsiders"])]
    plan += [("poor", levels[1 + i % 2], None) for i in range(mix["poor"])]
    robots = mix["robots"]
    cases = [
        draw_case(seed + i, kind, severity, name, robot=robots[i % len(robots)], ranges=ranges)
        for i, (kind, severity, name) in enumerate(plan)
    ]
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
    case: Case,
    folder: str | Path,
    answers: str | Path,
    command: Sequence[str],
    *,
    timeout: float,
    keep_data: bool,
    place: str = "run",
) -> Path | None:
    """Let another process work on one case, recorded where it is not yet, and give the path of what it concluded.

    Args:
        case: what is hidden.
        folder: of the cases. A verdict that is there already is taken as it is.
        answers: folder of the answers.
        command: `{data}`, `{model}` and `{run}` stand for the logs, the base model and the folder for the verdict;
            `{answer}` for the answer, of what may know it: such a command runs after all verdicts.
        timeout: after which the process is stopped [s].
        keep_data: whether the logs stay on the disk afterwards.
        place: name of the verdict's folder in the case's; beside it stands what the process has cost.

    Returns:
        Path of the verdict, None if none was written.
    """
    here = Path(folder) / case.name
    run = here / place
    verdict = run / VERDICT_FILE
    if verdict.is_file():
        return verdict
    if not (here / DATA_FOLDER).is_dir():
        make_case(case, folder, answers)
    run.mkdir(parents=True, exist_ok=True)
    names = {"data": here / DATA_FOLDER, "model": case.base, "run": run, "answer": Path(answers) / f"{case.name}.yaml"}
    cost = run_command([part.format(**names) for part in command], run / LOG_FILE, timeout)
    (run / COST_FILE).write_text(yaml.safe_dump(dataclasses.asdict(cost)), encoding="utf-8")
    if not keep_data:
        shutil.rmtree(here / DATA_FOLDER)
    return verdict if verdict.is_file() else None


def run_all(
    cases: Sequence[Case],
    folder: str | Path,
    answers: str | Path,
    command: Sequence[str],
    *,
    timeout: float = 1800.0,
    keep_data: bool = True,
    place: str = "run",
    say: Callable[[str], None] = print,
) -> dict[str, Path | None]:
    """Run every case that has no verdict yet; one line per case says how far it is. Arguments are those of `run_case`.

    Returns:
        Path of the verdict by case name, None where none was written.
    """
    found: dict[str, Path | None] = {}
    begin, done = time.monotonic(), 0
    for number, case in enumerate(cases, start=1):
        known = (Path(folder) / case.name / place / VERDICT_FILE).is_file()
        options: dict[str, Any] = {"timeout": timeout, "keep_data": keep_data, "place": place}
        found[case.name] = run_case(case, folder, answers, command, **options)
        if known:
            continue
        done += 1
        each = (time.monotonic() - begin) / done
        log = Path(folder) / case.name / place / LOG_FILE
        outcome = "" if found[case.name] else f"; no verdict, see {log}"
        say(f"case {number}/{len(cases)}, {each:.0f} s each, {each * (len(cases) - number) / 60:.0f} min left{outcome}")
    return found


def read_cost(verdict: Path) -> dict[str, float]:
    """What a diagnosis has cost, from beside its verdict; empty where that is not known."""
    path = verdict.parent / COST_FILE
    return yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}
