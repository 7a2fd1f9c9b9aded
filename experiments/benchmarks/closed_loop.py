"""Diagnose stand-in robots with hidden effects: findings, and the gap in three stages.

python experiments/benchmarks/closed_loop.py --robot leg --seed 300
python experiments/benchmarks/closed_loop.py --robot op3 --cases mild_dte,sound --seed 310
python experiments/benchmarks/closed_loop.py --robot arm3 --seed 320 --out outputs/closed_loop.yaml

Robots: `arm3`, three joints of an OP3's arm; `leg`, one leg; `op3`, the whole robot, all on the stand. The errors in
windows of the held-out runs are those of the given model, the baseline fit, the returned model, and the model with the
hidden effect, fitted in the same way. Each case runs in a separate process.
"""

import argparse
import resource
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from op3.diagnose import Diagnosis, split_logs
from op3.diagnose.base import gauss_newton
from op3.diagnose.findings import Search
from op3.diagnose.naming import NamingStage, Proposal
from op3.motions import Excitation, Motion, leg_suite
from op3.motions.op3_suites import leg_joints
from op3.replay.windows import WindowResiduals
from op3.robot import DEFAULT, load_robot
from op3.rollout import Rollout
from op3.scenes import build_scene
from op3.servo import RobotModel
from op3.sim import load_model
from op3.stand_in import cases as bench
from op3.stand_in.cases import Case, record_case
from op3.stand_in.hidden import Hidden
from op3.stand_in.suites import SETTINGS, Setting
from op3.stand_in.world import BENCH_RANGES, HiddenWorld

ARM = ("l_sho_pitch", "l_sho_roll", "l_el")


def arm_suite(seed: int) -> list[Excitation]:
    """The leg's suite for three joints of an arm, with larger amplitudes."""
    robot = load_robot(DEFAULT)
    indices = robot.indices(ARM)
    home, limits = robot.home[indices], robot.limits[indices]
    columns = [leg_joints().index(name) for name in ("r_hip_pitch", "r_hip_roll", "r_knee")]
    runs = []
    for run in leg_suite(seed):
        offset = run.motion.position[:, columns] - run.motion.position[:, columns].mean(0)
        position = np.clip(home + 1.5 * offset, limits[:, 0] + 0.02, limits[:, 1] - 0.02)
        motion = Motion(run.motion.time, position, ARM, run.motion.name, robot="op3")
        runs.append(Excitation(motion, run.p_gain, run.d_gain, run.tilt, run.warm))
    return runs


SETTINGS["arm3"] = Setting(partial(build_scene, "stand", "op3", joints=ARM), arm_suite, arm_suite)

PLACES = {
    "arm3": {"strong": "l_sho_pitch", "loose": "l_el", "end": "l_el", "link": ("l_el",)},
    "leg": {"strong": "r_knee", "loose": "r_hip_pitch", "end": "r_ank_pitch", "link": ("r_knee",)},
    "op3": {"strong": "r_knee", "loose": "r_hip_pitch", "end": "r_ank_pitch", "link": ("r_knee", "l_knee")},
}
"""Joints of the faults, by robot."""

Fault = Callable[[HiddenWorld, dict[str, Any]], tuple[str, HiddenWorld, tuple[Hidden, ...]]]


def hidden(name: str, size: float, where: str) -> Fault:
    """One effect in some joints."""

    def of(world: HiddenWorld, places: dict[str, Any]) -> tuple[str, HiddenWorld, tuple[Hidden, ...]]:
        joints = places[where] if isinstance(places[where], tuple) else (places[where],)
        return "paper", world, (Hidden(name, size, joints),)

    return of


def shared(name: str, base: str, **values: float) -> Fault:
    """One effect of all joints that the given model does not include."""

    def of(world: HiddenWorld, _: dict[str, Any]) -> tuple[str, HiddenWorld, tuple[Hidden, ...]]:
        return base, world.replace(**values), (Hidden(name, next(iter(values.values()))),)

    return of


FAULTS: dict[str, Fault] = {
    "mild_dte": shared("dte", "paper_without_dte", backward_efficiency=0.9),
    "strong_stribeck": shared("stribeck", "paper_without_stribeck", static_friction_excess=0.12),
    "sound": lambda world, _: ("paper", world, ()),
    "friction_x4": lambda world, places: hidden("coulomb", 3 * world.coulomb_friction, "strong")(world, places),
    "backlash_12": hidden("backlash", 0.006, "loose"),
    "backlash_20": hidden("backlash", 0.010, "loose"),
    "current_offset": hidden("current_offset", 0.03, "end"),
    "link_mass": hidden("link_mass", 0.08, "link"),
    "cable_spring": hidden("cable_spring", 0.15, "strong"),
}
"""Hidden effects: the given model, the world, and the effects added to it."""


def case_of(fault: str, robot: str, seed: int) -> Case:
    """A random robot with a fault."""
    base, world, effects = FAULTS[fault](HiddenWorld.random(seed, BENCH_RANGES), PLACES[robot])
    joints = tuple(str(joint.name) for joint in SETTINGS[robot].scene().joints)
    kind = "single" if effects else "null"
    return bench.Case(f"{fault}_{robot}_{seed}", seed, kind, None, base, world, effects, joints, robot)


def with_hidden_effect(search: Search, stage: NamingStage, hidden: Hidden) -> RobotModel | None:
    """The model with the hidden effect, fitted with the baseline like a finding; None if it is no candidate because the
    baseline fit includes it."""
    names = search.reduction.engine.joints
    hypothesis = hidden.name, tuple(sorted(names.index(joint) for joint in hidden.joints)) or None
    odds = stage.judge.scores(stage.fit)
    indices = [i for i, candidate in enumerate(stage.candidates) if candidate.hypothesis == hypothesis]
    if not indices:
        return None
    index = max(indices, key=lambda i: float(odds[i]))
    fit, control = (stage.judge.fit(named, stage.fit.variances, rounds=2) for named in ([index], []))
    step = (fit.mean[:-1] - control.mean)[: len(stage.base.point)]
    best = search.refitted(stage, [Proposal(index, step, float(fit.mean[-1]), fit.variances)])[0][0].base
    return gauss_newton(search.reduction, best.coordinates, best.point, variances=best.fit.variances).model


def window_errors(models: Sequence[RobotModel], logs: Sequence[Rollout]) -> list[list[float]]:
    """RMS errors in windows of 0.2 s, by model: angle [mrad] and current [mA]."""
    engine, result = WindowResiduals(logs, windows=8 * len(logs)), []
    for model in models:
        values = model.tensors(engine.joints)["torque_constant"]
        error = engine.errors(model, {"torque_constant": values.double().reshape(1, -1)}, 1)[0]
        square = np.square(np.clip(error, -0.5, 0.5))
        result.append([1e3 * float(np.sqrt(square[..., k][..., engine.known[:, k]].mean())) for k in (0, 2)])
        engine.forget()
    return result


def diagnosed(case: Case) -> dict[str, Any]:
    """Diagnosis of a case; memory is the peak of its process before the model with the hidden effect is fitted."""
    torch.set_num_threads(1)
    logs = list(record_case(case))
    given, split = load_model(case.base), split_logs(logs, seed=0)
    began, cpu = time.monotonic(), time.process_time()
    diagnosis = Diagnosis(given, split, seed=0)
    verdict = diagnosis.run()
    spent, cpu = time.monotonic() - began, time.process_time() - cpu
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    models, search = [given, verdict.base, verdict.model], diagnosis.search
    if case.hidden and search is not None:
        with_effect = with_hidden_effect(search, diagnosis.stages[0], case.hidden[0])
        models += [] if with_effect is None else [with_effect]
    errors = window_errors(models, split.show)
    findings = [
        {
            "effect": one.effect, "joints": "all" if one.shared else " ".join(one.joints), "size": round(one.size, 5),
            "probability": round(one.probability, 2),
            "in_model": one.of_base or one.effect in verdict.model.effect_names,
        }
        for one in verdict.findings
    ]  # fmt: skip
    horizons = {} if verdict.windows is None else verdict.windows.horizons
    return {
        "case": case.name, "findings": findings, "mrad": [round(one[0], 2) for one in errors],
        "mA": [round(one[1], 2) for one in errors],
        "horizons": {
            str(length): [round(1e3 * value, 2) for value in (one.given, one.baseline, one.returned)]
            for length, one in horizons.items()
        },
        "wall": round(spent), "cpu": round(cpu), "MB": round(memory),
        "stages": {name: round(value) for name, value in verdict.seconds.items()},
    }  # fmt: skip


def line(row: dict[str, Any]) -> str:
    """The result of a case as one line."""
    named = "; ".join(
        f"{one['effect']} in {one['joints']} {one['size']:g} p {one['probability']:.2f}" for one in row["findings"]
    )
    angle = " -> ".join(f"{value:.2f}" for value in row["mrad"][:3])
    current = " -> ".join(f"{value:.1f}" for value in row["mA"][:3])
    known = f" ({row['mrad'][3]:.2f} with the hidden effect given)" if len(row["mrad"]) > 3 else ""
    cost = f"{row['wall']} s, {row['cpu']} s of processor time, {row['MB']} MB"
    return f"{row['case']:24} {angle}{known} mrad, {current} mA, {cost}: {named or 'nothing'}"


def main() -> None:
    """Diagnose and print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", choices=sorted(PLACES), default="leg")
    parser.add_argument("--cases", default=",".join(FAULTS))
    parser.add_argument(
        "--seed", type=int, default=300, help="seed of the first robot; each following case has the next seed"
    )
    parser.add_argument("--out", type=Path, help="file to which all results are written")
    given = parser.parse_args()
    cases = [case_of(fault, given.robot, given.seed + i) for i, fault in enumerate(given.cases.split(","))]
    rows = []
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
        for row in pool.map(diagnosed, cases):
            rows.append(row)
            print(line(row), flush=True)
            if given.out:
                given.out.parent.mkdir(parents=True, exist_ok=True)
                given.out.write_text(yaml.safe_dump(rows, sort_keys=False), encoding="utf-8")


if __name__ == "__main__":
    main()
