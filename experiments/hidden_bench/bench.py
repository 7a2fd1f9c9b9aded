"""A bench of many cases: selection of the cases, and diagnosis in a separate process."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from op3.stand_in.cases import DATA_FOLDER, TEST_SEEDS, Case, draw_case, make_case
from op3.stand_in.hidden import CATALOGUE, OUTSIDERS, SEVERITIES
from op3.stand_in.world import BENCH_RANGES, Ranges

VERDICT_FILE = "verdict.yaml"
LOG_FILE = "diagnose.log"
COST_FILE = "cost.yaml"
GRACE = 10.0
"""Time that a process gets to end after it was asked to stop [s]."""

SETS: tuple[str, ...] = ("development", "test")
"""Sets of cases with separate seeds; constants are chosen on the first, the second is opened once per release."""


def draw_mix(
    mix: Mapping[str, Any], which: str = "development", first_seed: int = 0, ranges: Ranges = BENCH_RANGES
) -> list[Case]:
    """The cases of a bench, each with a separate seed, in the order of their names, which is random.

    Args:
        mix: `robots`: robots on which the cases are recorded, alternately; `singles`: cases per effect, by severity;
            `effects`: effects to hide (None: all of the catalogue); `nulls`, `pairs`, `outsiders`, `poor`: numbers of
            cases.
        which: "development" or "test".
        first_seed: first seed of the set.
        ranges: ranges of the robots' parameters.
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


@dataclass(frozen=True)
class Cost:
    """Resources used by a process and by the processes that it started and waited for.

    Attributes:
        seconds: wall time [s].
        processor_seconds: processor time [s].
        peak_memory: largest resident set of one process [bytes].
    """

    seconds: float
    processor_seconds: float
    peak_memory: int


def run_command(command: Sequence[str], log: Path, timeout: float) -> Cost:
    """Run a command to its end or for `timeout` [s], with all processes that it starts.

    Args:
        command: program and arguments.
        log: file for the output of the command.
        timeout: [s].
    """
    begin = time.monotonic()
    limited = ["timeout", f"--kill-after={GRACE:g}", f"{timeout:g}", *command]
    with log.open("w", encoding="utf-8") as out:
        process = subprocess.Popen(limited, stdout=out, stderr=subprocess.STDOUT)
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except KeyboardInterrupt:
            process.terminate()  # which `timeout` passes on
            raise
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode in (124, 137, -9):  # of `timeout`, once it has stopped the command
        with log.open("a", encoding="utf-8") as out:
            out.write(f"\nstopped after {timeout:g} s\n")
    # Linux counts the resident set in kilobytes
    return Cost(time.monotonic() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024)


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
    """Record one case if necessary, diagnose it in another process, and return the path of the verdict.

    Args:
        case: the hidden effects.
        folder: folder of the cases; an existing verdict is kept.
        answers: folder of the answers.
        command: `{data}`, `{model}` and `{run}` stand for the logs, the base model and the folder for the verdict;
            `{answer}` stands for the answer, for baselines that may use it: they run after all verdicts.
        timeout: time after which the process is stopped [s].
        keep_data: whether the logs are kept.
        place: name of the verdict's folder in the case's folder; it also contains the cost of the process.

    Returns:
        Path of the verdict; None if none was written.
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
    """Run every case that has no verdict yet, and print a progress line for each. Arguments are those of `run_case`.

    Returns:
        Path of the verdict by case name; None if none was written.
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
    """Cost of a diagnosis, read from the file beside its verdict; empty if unknown."""
    path = verdict.parent / COST_FILE
    return yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}
