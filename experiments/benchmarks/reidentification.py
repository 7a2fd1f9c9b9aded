"""Measure how far re-identification closes the gap of returns on hidden robots, and its cost.

python experiments/benchmarks/reidentification.py [robots=[robot_1,robot_2]] [trials=3000] [policy=<bundle>]
    [diagnose=true]

Each robot squats, is identified (method=lsq), plays ten episodes of a policy behind its emulated bus, and is
re-identified from them. The policy is trained for each on its identified model, unless one is given. With
`diagnose=true` each is re-identified a second time, from a model to which a diagnosis of further motions has added the
missing effects. Every stage has a separate folder; the same command with the same hydra.run.dir continues after an
interruption.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from op3.apps.collect import collect
from op3.apps.diagnose import diagnose
from op3.apps.fields import plain
from op3.apps.identify import identify
from op3.apps.job import one_sentence
from op3.apps.reidentify import reidentify
from op3.apps.stages import Stages
from op3.apps.train import train
from op3.report import Page, read_result, run_provenance, write_result
from op3.report.tables import TableRows

TOLERATED = 1.25
"""The excitation loss may rise by a quarter."""

AIM = 0.4
"""Target for the median distance, as a share of that after excitation only."""


def one_robot(cfg: DictConfig, stages: Stages, robot: str) -> dict[str, dict[str, Any]]:
    """Run all stages of a robot; return results and costs of its re-identification by each method."""
    hidden = {"source": "emulated", "world": robot, "seed": cfg.seed}
    squat = stages.run(f"{robot}/squat", collect, **hidden, motion="squat")
    how = {"method": "lsq", "ablate": [], "overrides": plain(cfg.identify)}
    model = stages.run(f"{robot}/identify", identify, data=squat, seed=cfg.seed, **how) / "model.yaml"
    policy = cfg.policy
    if policy is None:
        how = {"task": "balance", "model": model, "seed": cfg.seed, "wandb": "offline", "overrides": plain(cfg.train)}
        policy = stages.run(f"{robot}/train", train, **how) / "policy"
    plays = {"policy": policy, "task": cfg.task, "repeats": cfg.episodes}
    episodes = stages.run(f"{robot}/episodes", collect, **hidden, **plays)
    what = {"policy": policy, "data": squat, "episodes": episodes, "task": cfg.task, "seed": cfg.seed}
    how = [f"hydra.sweeper.n_trials={cfg.trials}", f"repeats={cfg.episodes}", *plain(cfg.reidentify)]

    def reidentified(name: str, start: Path) -> dict[str, Any]:
        found = stages.run(f"{robot}/{name}", reidentify, **what, model=start, overrides=how)
        numbers = read_result(found / "result.yaml")
        return {
            **{key: numbers[key] for key in KEYS},
            "return.actual": float(np.mean(numbers["returns.actual"])),
            "return.excitation_only": float(np.mean(numbers["returns.excitation_only"])),
            "return.reidentified": float(np.mean(numbers["returns.reidentified"])),
            "reidentify_seconds": stages.seconds[f"{robot}/{name}"],
            "reidentify_processor_seconds": stages.processor_seconds[f"{robot}/{name}"],
        }

    found = {"reidentify": reidentified("reidentify", model)}
    if cfg.diagnose:
        stand = stages.on_stand(f"{robot}/stand", list(cfg.diagnosis), hidden)
        named = stages.run(f"{robot}/diagnose", diagnose, data=stand, model=model, seed=cfg.seed)
        found["diagnose"] = reidentified("diagnosed_reidentify", named / "model.yaml")
        found["diagnose"]["verdict"] = yaml.safe_load((named / "verdict.yaml").read_text())["sentence"]
    return found


KEYS = (
    "distance.excitation_only",
    "distance.reidentified",
    "distance.ratio",
    "fresh.excitation_only",
    "fresh.reidentified",
    "fresh.ratio",
    "fresh.noise",
    "excitation.excitation_only",
    "excitation.reidentified",
    "excitation.ratio",
    "accepted",
    "at_chance",
    "trials",
    "trials_played",
    "trials_skipped",
)
"""Numbers of a re-identification that are compared."""


def summarise(robots: dict[str, dict[str, dict[str, Any]]]) -> dict[str, Any]:
    """Medians over robots, and whether they reach the target.

    Args:
        robots: results by robot and method: ``reidentify``, and ``diagnose`` if both were run.
    """
    plain_road = {robot: roads["reidentify"] for robot, roads in robots.items()}

    def median(key: str) -> float | None:
        return _median([one[key] for one in plain_road.values()])

    rises = [one["excitation.ratio"] for one in plain_road.values()]
    fresh = median("fresh.ratio")
    numbers: dict[str, Any] = {
        "robots": len(robots),
        "median.distance_ratio": median("distance.ratio"),
        "median.fresh_ratio": median("fresh.ratio"),
        "largest.excitation_ratio": max(rises),
        # over episodes that neither search nor choice has seen
        "met": fresh is not None and fresh <= AIM and max(rises) <= TOLERATED,
        "processor_seconds_per_trial": sum(one["reidentify_processor_seconds"] for one in plain_road.values())
        / sum(one["trials"] for one in plain_road.values()),
        **{f"{robot}.{key}": value for robot, one in plain_road.items() for key, value in one.items()},
    }
    both = {robot: roads for robot, roads in robots.items() if "diagnose" in roads}
    for robot, roads in both.items():
        numbers |= {f"{robot}.diagnosed.{key}": value for key, value in roads["diagnose"].items()}
    for name, key in SHARES.items():
        if both:
            numbers[f"diagnosed.median.{name}"] = _median([against(roads, key) for roads in both.values()])
    return numbers


def _median(values: Sequence[float | None]) -> float | None:
    """Median of the existing ratios; a robot whose initial model is perfect has none."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


SHARES = {"distance_ratio": "distance", "fresh_ratio": "fresh", "excitation_ratio": "excitation"}
"""Reported quantities of models that were diagnosed first, as shares of the values after excitation only."""


def against(roads: dict[str, dict[str, Any]], key: str) -> float | None:
    """Value after diagnosis and re-identification, as a share of the value after excitation only."""
    left, before = roads["diagnose"][f"{key}.reidentified"], roads["reidentify"][f"{key}.excitation_only"]
    return left / before if left is not None and before else None


PROSE = """
# Re-identification on hidden robots
Over fresh episodes, the distance of returns falls to {n[median.fresh_ratio]:.2g} times its value after excitation only
(median of {count} robots); over the episodes of the search, to {n[median.distance_ratio]:.2g} times that value.
The excitation loss rises to at most {n[largest.excitation_ratio]:.2f} times its initial value.

[[table reidentify | Returns under R_eval and their Wasserstein-1 distance to the robot's; the start is the model
identified from the squat alone. | 3]]

[[table diagnose | The same, starting from a model to which a diagnosis has first added the missing effects. | 3]]

[[table both | Both methods, as shares of the values after excitation only. | 3]]

"""
LINK = "[[file {0}/reidentify/index.html | re-identification of {0}]]\n"


def report(folder: Path, robots: dict[str, dict[str, dict[str, Any]]], seed: int) -> None:
    """Write page and numbers."""
    numbers = summarise(robots)
    provenance = run_provenance(seed=seed)
    meanings = {"median": "over robots; distances are Wasserstein-1, as shares of those after excitation only"}
    result = write_result(folder / "result.yaml", {**numbers, "provenance": provenance}, meanings)
    header = ["robot", "mean return on the robot", "initial model", "re-identified", "initial distance", "after",
              "ratio", "initial distance, fresh", "after", "by chance", "excitation loss, ratio", "trials",
              "trials that played"]  # fmt: skip
    keys = ("return.actual", "return.excitation_only", "return.reidentified", "distance.excitation_only",
            "distance.reidentified", "distance.ratio", "fresh.excitation_only", "fresh.reidentified", "fresh.noise",
            "excitation.ratio", "trials", "trials_played")  # fmt: skip
    tables: dict[str, TableRows] = {
        road: (header, [[name, *(roads[road][key] for key in keys)] for name, roads in robots.items() if road in roads])
        for road in ("reidentify", "diagnose")
    }
    tables["both"] = (
        ["robot", "verdict", "distance", "diagnosed first", "fresh distance", "diagnosed first",
         "excitation loss, ratio", "diagnosed first"],
        [
            [robot, roads["diagnose"]["verdict"], *(
                value for key in SHARES.values()
                for value in (roads["reidentify"][f"{key}.ratio"], against(roads, key)))]
            for robot, roads in robots.items() if "diagnose" in roads
        ],
    )  # fmt: skip
    page = Page(PROSE.format(n=numbers, count=len(robots)) + "".join(map(LINK.format, robots)), tables=tables)
    page.provenance(provenance)
    print(page.write(folder / "index.html"), result, sep="\n", flush=True)


@hydra.main(config_path="../../conf/benchmark", config_name="reidentification", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Process the robots, and update the report after each of them."""
    with one_sentence():
        folder = Path(HydraConfig.get().runtime.output_dir).absolute()
        stages = Stages(folder)
        robots: dict[str, dict[str, dict[str, Any]]] = {}
        for robot in cfg.robots:
            robots[robot] = one_robot(cfg, stages, robot)
            report(folder, robots, cfg.seed)


if __name__ == "__main__":
    main()
