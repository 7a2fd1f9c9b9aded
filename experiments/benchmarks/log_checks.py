"""Measure false alarms and costs of the log checks.

python experiments/benchmarks/log_checks.py sound [CASES] [LOGS ...]
python experiments/benchmarks/log_checks.py cost

`sound` counts findings in the given logs, and in stand-ins that each have one strong effect of the catalogue, in
every setting of the bench. `cost` measures reading and checking ten minutes of twenty joints at 125 Hz, as a folder and
as CSV, and the checks of a squat compared with `identify.py method=lsq` on it.
"""

import argparse
import logging
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path

import numpy as np

from op3.rollout import LogError, Metadata, Rollout, read_log, read_logs
from op3.rollout.health import ERROR, examine
from op3.stand_in.cases import draw_case, record_case
from op3.stand_in.hidden import CATALOGUE
from op3.stand_in.suites import SETTINGS

ROOT = Path(__file__).resolve().parents[2]
RUNS = 2
"""Runs of every case that are checked."""


def stand_ins(cases: int) -> Iterator[tuple[str, Rollout]]:
    """Runs of stand-ins with one strong effect each."""
    effects = [(name, robot) for robot in SETTINGS for name in CATALOGUE]
    step = max(1, len(effects) // max(1, cases))
    for seed, (name, robot) in enumerate(islice(cycle(effects), 0, step * cases, step)):
        try:
            case = draw_case(seed, "single", "strong", name, robot=robot)
            for log in islice(record_case(case), RUNS):
                yield f"{name} on {robot}", log
        except ValueError as error:  # an effect that this robot cannot have, or a motion that it cannot make
            print(f"{name} on {robot}: not drawn ({str(error)[:80]})")


def sound(cases: int, paths: list[str]) -> None:
    """Print every finding in sound logs, and the number of logs with findings."""
    logs, errors, warned = 0, 0, 0
    named = ((f"{path}: {log.metadata.recording}", log) for path in paths for log in _read(path))
    for name, log in (pair for source in (named, stand_ins(cases)) for pair in source):
        findings = log.findings or examine(log)
        logs, errors = logs + 1, errors + any(f.severity == ERROR for f in findings)
        warned += any(f.severity != ERROR for f in findings)
        for finding in findings:
            print(f"{name}: {finding.severity}: {finding.error(None)}", flush=True)
    print(f"{logs} logs, {errors} with an error, {warned} with a warning")


def _read(path: str) -> list[Rollout]:
    try:
        return read_logs(path)
    except LogError as error:
        print(f"refused: {error}")
        return []


def long_log() -> Rollout:
    """Ten minutes of twenty joints."""
    time = np.arange(75_000)[:, None] / 125
    phase, late = np.arange(20), time - 0.03
    position = np.round(0.5 * np.sin(2 * late + phase) / 0.0015) * 0.0015
    speed = np.round(np.cos(2 * late + phase) / 0.024) * 0.024
    arrays = {"time": time, "command/position": 0.5 * np.sin(2 * time + phase), "joint/position": position}
    about = Metadata(tuple(f"joint_{i}" for i in range(20)), "real", "stand", 125.0)
    return Rollout.from_arrays({**arrays, "joint/velocity": speed, "joint/current": 0.1 * speed}, about)


def cost() -> None:
    """Print the time and memory that the checks take."""
    with tempfile.TemporaryDirectory() as place:
        log = long_log()
        log.save(f"{place}/run")
        log.to_csv(f"{place}/run.csv")
        for name in ("run", "run.csv"):
            code = "import sys, time; from op3.rollout import read_log; import op3.rollout.health\n"
            # the peak of this process, where ru_maxrss begins with its parent's
            code += "used = lambda: int(open('/proc/self/status').read().split('VmHWM:')[1].split()[0]) / 1024\n"
            code += "before, start = used(), time.process_time(); read_log(sys.argv[1])\n"
            code += "print(f'{sys.argv[1][-7:]}: {time.process_time() - start:.2f} s, {used() - before:.0f} MB')"
            subprocess.run([sys.executable, "-c", code, f"{place}/{name}"], check=True, cwd=ROOT)
        collect = ["experiments/collect.py", f"hydra.run.dir={place}/squat"]
        subprocess.run([sys.executable, *collect], check=True, cwd=ROOT, capture_output=True)
        squat = read_log(f"{place}/squat/squat-0")
        start = time.process_time()
        for _ in range(10):
            examine(squat)
        checks = (time.process_time() - start) / 10
        fit = [f"data={place}/squat/squat-0", "method=lsq", "wandb=disabled", f"hydra.run.dir={place}/fit"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        subprocess.run([sys.executable, "experiments/identify.py", *fit], check=True, cwd=ROOT, capture_output=True)
        spent = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        print(f"checks of a squat {checks:.3f} s, identify method=lsq {spent:.1f} s: {checks / spent:.2%}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    measures = parser.add_subparsers(dest="measure", required=True)
    measures.add_parser("cost", help="time and memory")
    alarms = measures.add_parser("sound", help="findings in sound logs")
    alarms.add_argument(
        "cases", type=int, nargs="?", default=100, help="number of stand-ins, each with one hidden effect"
    )
    alarms.add_argument("logs", nargs="*", help="further logs to examine")
    args = parser.parse_args()
    logging.disable()
    if args.measure == "cost":
        cost()
    else:
        sound(args.cases, args.logs)
