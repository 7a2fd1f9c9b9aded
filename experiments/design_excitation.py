"""Choose the motions that narrow the intervals of chosen parameters most per second of robot time.

python experiments/design_excitation.py groups=[gear,friction] seconds=60 [mounts=[floor]] [model=<model.yaml>]
python experiments/collect.py plan=<its folder>/plan.yaml source=stand_in
"""

import time
from pathlib import Path
from typing import Any

import hydra
import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from support import library_motion, one_sentence, plain, positive

from op3.command_line import launch
from op3.identify.design import Candidate, check_choice, choose, information
from op3.identify.identification import PREFIX
from op3.identify.resolvers import chosen_model
from op3.identify.resolvers import register as register_interpolations
from op3.identify.search_space import parse_search_space
from op3.identify.sweeper import register as register_sweeper
from op3.report import RunFolder, run_provenance
from op3.report.design_page import report_design
from op3.robot import load_robot, named_configs

register_interpolations()
register_sweeper()


def judge(cfg: DictConfig, bounds: dict[str, tuple[float, float]]) -> tuple[list[Candidate], dict[str, str]]:
    """Simulate every motion on every mount, and say which cannot be judged."""
    model, robot = chosen_model(cfg), load_robot(cfg.robot)
    joints = robot.controlled if cfg.joints is None else tuple(cfg.joints)
    robot.indices(joints)  # before minutes of motions
    candidates, left_out = [], {}
    for name in plain(cfg.motions) or sorted(named_configs("motion")):
        motion = library_motion(name, cfg.robot)
        if load_robot(motion.robot).path != robot.path:
            continue
        for mount in (place for place in motion.mounts if place in cfg.mounts):
            try:
                matrix = information(model, motion, mount, bounds, joints=joints)
            except ValueError as error:
                left_out[f"{name} on the {mount}"] = str(error)
                continue
            candidates.append(Candidate(name, mount, motion.duration, matrix))
            print(f"{name} on the {mount}: {motion.duration:.1f} s", flush=True)
    if not candidates:
        raise ValueError(f"none of the motions can be judged on mounts={list(cfg.mounts)}: {left_out or 'no motion'}")
    return candidates, left_out


@hydra.main(config_path="../conf", config_name="design_excitation", version_base="1.3")
def main(cfg: DictConfig) -> dict[str, Any]:
    """Judge the library, choose, write the plan."""
    with one_sentence(cfg=cfg):
        torch.set_num_threads(1)
        started = time.monotonic()
        folder = Path(HydraConfig.get().runtime.output_dir)
        space = parse_search_space(plain(HydraConfig.get().sweeper.params))
        bounds = {name: _ends(space[PREFIX + name]) for name in cfg.parameters if PREFIX + name in space}
        wanted = list(bounds) if cfg.wanted is None else list(cfg.wanted)
        check_choice(list(bounds), wanted, cfg.criterion)
        positive(cfg, "seconds", "seconds")
        candidates, left_out = judge(cfg, bounds)
        steps = choose(
            candidates,
            list(bounds),
            wanted,
            criterion=cfg.criterion,
            seconds=cfg.seconds,
            overhead=cfg.overhead,
            mount_change=cfg.mount_change,
            repeats=cfg.repeats,
        )
        plan = {"plan": [{"motion": step.name, "mount": step.mount} for step in steps]}
        (folder / "plan.yaml").write_text(yaml.safe_dump(plan, sort_keys=False))
        return report_design(
            steps,
            candidates,
            wanted,
            left_out,
            RunFolder(folder, run_provenance(seed=cfg.seed)),
            time.monotonic() - started,
        )


def _ends(distribution: Any) -> tuple[float, float]:
    return float(distribution.low), float(distribution.high)


if __name__ == "__main__":
    launch(main, "design_excitation", __doc__)
