"""How often the 90 % intervals of `method=lsq` contain the true values, in random worlds without hidden effects.

python experiments/benchmarks/interval_coverage.py [worlds=40] [motions=[squat,push_down]]

A world is the identified simulation itself with parameters drawn uniformly from their ranges (paper Table I), read by
sensors with the noise and the registers of the robot. The stand-in is not suitable: its gear and friction obey other
laws, so it has no true values of these parameters. Every world is a line of `worlds.jsonl` in the run's
folder; the same command continues after an interruption. A world in which the robot falls is drawn again.
"""

import json
import time
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from op3.apps.fields import plain
from op3.apps.job import one_sentence
from op3.apps.support import library_motion
from op3.identify.identification import PREFIX, Identification
from op3.identify.loss import TrajectoryLoss
from op3.identify.search_space import parse_search_space
from op3.identify.study import StudySettings, run_study
from op3.motions import Motion
from op3.replay import simulate_motion
from op3.report import Page, run_provenance, write_result
from op3.robot import load_robot
from op3.robot.register_units import CURRENT_UNIT, POSITION_UNIT, VELOCITY_UNIT
from op3.rollout import Rollout
from op3.servo import RobotModel
from op3.sim import load_model

NOISE = {
    ("joint", "position"): 0.0,
    ("joint", "velocity"): 0.01,
    ("joint", "current"): 0.002,
    ("imu", "orientation"): 0.0005,
    ("imu", "angular_velocity"): 0.002,
}
"""Standard deviations of sensor noise before rounding to registers, in SI units."""

UNITS = {
    ("joint", "position"): POSITION_UNIT,
    ("joint", "velocity"): VELOCITY_UNIT,
    ("joint", "current"): CURRENT_UNIT,
}


def record(model: RobotModel, motion: Motion, rng: np.random.Generator) -> Rollout | None:
    """A log of the simulation with sensor noise and register units; None if it fell or diverged."""
    try:
        truth = simulate_motion(model, motion)
    except ValueError:
        return None
    if truth.metadata.fallen:
        return None
    commands = {key: truth.array(key) for key in ("time", "command/position", "command/p_gain", "command/d_gain")}
    measured = {}
    for key, deviation in NOISE.items():
        value = truth.array(key)
        value = value + deviation * rng.standard_normal(value.shape)
        measured[key] = np.round(value / UNITS[key]) * UNITS[key] if key in UNITS else value
    return Rollout.from_arrays({**commands, **measured}, truth.metadata)


def one_world(cfg: DictConfig, number: int, motions: list[Motion]) -> dict[str, Any]:
    """Draw a world, record it, identify it, and return which intervals contain the true values."""
    started = time.monotonic()
    rng = np.random.default_rng([cfg.seed, number])
    base = load_model(cfg.model)
    ranges = {name: base.parameters()[name] for name in cfg.parameters}
    while True:
        truth = {name: float(rng.uniform(p.low, p.high)) for name, p in ranges.items()}
        logs = [record(base.with_values(truth), motion, rng) for motion in motions]
        kept = [log for log in logs if log is not None]
        if len(kept) == len(motions):
            break
    loss = TrajectoryLoss(load_robot("op3").controlled, skip=cfg.skip)
    problem = Identification(base, kept, [], list(ranges), joints=load_robot("op3").controlled, loss=loss)
    space = parse_search_space({PREFIX + name: f"interval({p.low}, {p.high})" for name, p in ranges.items()})
    nominal = {PREFIX + name: p.nominal for name, p in ranges.items()}
    how = StudySettings(space, "random", n_trials=cfg.trials, population=cfg.trials, nominal=nominal, seed=number)
    study = run_study(problem.evaluate, how, progress=False)
    fit = problem.finish(study, **plain(cfg.refine))
    assert fit.identifiability is not None
    found = {name: fit.model.estimates[name] for name in ranges}
    return {
        "world": number,
        "truth": truth,
        "found": {name: e.value for name, e in found.items()},
        "low": {name: e.low for name, e in found.items()},
        "high": {name: e.high for name, e in found.items()},
        "covered": {n: bool((e.low or 0.0) <= truth[n] <= (e.high or 0.0)) for n, e in found.items()},
        "identifiable": dict(fit.identifiability.identifiable),
        "loss": fit.fit.loss,
        "loss_of_truth": problem.score(truth)[0].loss,
        "simulated_seconds": fit.simulated_seconds,
        "wall_seconds": time.monotonic() - started,
    }


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The finished worlds; a line truncated by an interruption is omitted."""
    worlds = []
    for line in path.read_text().splitlines() if path.is_file() else ():
        try:
            worlds.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return worlds


def append(path: Path, world: dict[str, Any]) -> None:
    """Append a line; an earlier truncated line stays separate."""
    torn = path.is_file() and not path.read_text().endswith("\n")
    with path.open("a") as file:
        file.write("\n" * torn + json.dumps(world) + "\n")


def summarise(worlds: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    """Coverage pooled over identifiable parameters, and of each parameter.

    Least squares that ends above the loss of the truth has missed the minimum; worlds in which it has not are counted
    by themselves too, which tells intervals from search.
    """
    pooled = [w["covered"][n] for w in worlds for n in names if w["identifiable"][n]]
    reached = [w for w in worlds if w["loss"] <= w["loss_of_truth"]]
    pooled_reached = [w["covered"][n] for w in reached for n in names if w["identifiable"][n]]
    low = [w["truth"][n] < w["low"][n] for w in worlds for n in names if w["identifiable"][n]]
    return {
        "worlds": len(worlds),
        "coverage.pooled": float(np.mean(pooled)) if pooled else None,
        "coverage.pooled_count": len(pooled),
        "coverage.minimum_reached": len(reached),
        "coverage.pooled_where_reached": float(np.mean(pooled_reached)) if pooled_reached else None,
        "coverage.truth_below": float(np.mean(low)) if low else None,
        "covered": {n: sum(w["covered"][n] for w in worlds) for n in names},
        "identifiable_in": {n: sum(w["identifiable"][n] for w in worlds) for n in names},
        "covered_where_identifiable": {n: sum(w["covered"][n] and w["identifiable"][n] for w in worlds) for n in names},
        "wall_seconds": sum(w["wall_seconds"] for w in worlds),
        "simulated_seconds": sum(w["simulated_seconds"] for w in worlds),
    }


def report(folder: Path, worlds: list[dict[str, Any]], names: list[str], seed: int) -> None:
    """Write page and result."""
    numbers = summarise(worlds, names)
    meanings = {
        "coverage": "share of 90 % intervals that contain the true value, over identifiable parameters of all worlds",
        "covered": "number of worlds whose interval contains the true value, by parameter",
        "identifiable_in": "number of worlds in which the parameter is identifiable",
    }
    provenance = run_provenance(seed=seed)
    result = write_result(folder / "result.yaml", {**numbers, "provenance": provenance}, meanings)
    pooled = numbers["coverage.pooled"]
    lead = f"{0 if pooled is None else pooled:.1%} of the intervals contain the true value."
    lead += f" Least squares reached the minimum in {numbers['coverage.minimum_reached']} of {len(worlds)} worlds"
    within = numbers["coverage.pooled_where_reached"]
    lead += "." if within is None else f"; in these, {within:.1%} of the intervals contain it."
    rows = [
        [name.replace("_", " "), numbers["covered"][name], numbers["covered_where_identifiable"][name],
         numbers["identifiable_in"][name], len(worlds)]
        for name in names
    ]  # fmt: skip
    header = ["parameter", "covered", "covered where identifiable", "identifiable", "worlds"]
    prose = f"# Coverage of 90 % intervals\n{lead}\n\n[[table parameters]]"
    page = Page(prose, tables={"parameters": (header, rows)})
    page.provenance(provenance)
    print(page.write(folder / "index.html"), result, sep="\n", flush=True)


@hydra.main(config_path="../../conf/benchmark", config_name="interval_coverage", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Simulate and identify the missing worlds, then report."""
    with one_sentence():
        torch.set_num_threads(1)
        folder = Path(HydraConfig.get().runtime.output_dir)
        folder.mkdir(parents=True, exist_ok=True)
        lines = folder / "worlds.jsonl"
        motions = [library_motion(name) for name in cfg.motions]
        done = {world["world"] for world in read_lines(lines)}
        numbers = range(cfg.first, cfg.first + cfg.worlds)
        for number in numbers:
            if number in done:
                continue
            world = one_world(cfg, number, motions)
            append(lines, world)
            hits = sum(world["covered"].values())
            text = f"world {number}: {hits} of {len(world['covered'])} covered, {world['wall_seconds']:.0f} s"
            print(text, flush=True)
        worlds = sorted((w for w in read_lines(lines) if w["world"] in numbers), key=lambda world: world["world"])
        report(folder, worlds, list(cfg.parameters), cfg.seed)


if __name__ == "__main__":
    main()
