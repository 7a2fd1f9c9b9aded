"""Record a motion or a policy on a robot, once or several times.

python experiments/collect.py robot=stand_in motion=squat [world=eta_060] [mount=stand] [repeats=3] [seed=1]
python experiments/collect.py world=random world_seed=7 motion=squat_heldout
python experiments/collect.py robot=emulated|real motion=squat [port=/dev/ttyUSB0] [mount=stand]
python experiments/collect.py robot=emulated|real policy=assets/policies/balance [duration=10] [repeats=5]
python experiments/collect.py -m world=eta_060,eta_070,eta_080
"""

import datetime
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from support import git_hash, one_sentence

from op3.deploy import Stop
from op3.deploy.bus import Unplugged
from op3.deploy.exit_codes import ExitCode
from op3.policy import PolicyBundle
from op3.rollout import MOUNTS, Rollout


def build(node: DictConfig) -> Any:
    """What a config node describes; a refusal is passed on in its own words."""
    try:
        return instantiate(node)
    except InstantiationException as error:
        raise ValueError(str(error.__cause__ or error)) from error


def collect(cfg: DictConfig) -> list[Path]:
    """Record as often as asked and return the rollout folders."""
    if cfg.mount not in MOUNTS[:2]:
        raise ValueError(f"mount must be {' or '.join(MOUNTS[:2])}, got {cfg.mount!r}")
    if isinstance(cfg.repeats, bool) or not isinstance(cfg.repeats, int) or cfg.repeats < 1:
        raise ValueError(f"repeats must be a whole number of at least 1, got {cfg.repeats!r}")
    robot = build(cfg.robot)
    name, record = recording(cfg, robot)
    runtime = HydraConfig.get().runtime
    known = {"date": datetime.datetime.now().isoformat(timespec="seconds"), "git_hash": git_hash()}
    folders = []
    for number in range(cfg.repeats):
        label = f"{name}-{number}"
        rollout = record(label)
        rollout = Rollout(rollout.data, rollout.metadata.replace(**known))
        folders.append(rollout.save(Path(runtime.output_dir) / label))
        outcome = "the robot fell" if rollout.metadata.fallen else "the robot stands"
        print(f"{folders[-1]}: {rollout.rows} rows, {rollout.duration:.2f} s, {outcome}")
    return folders


def recording(cfg: DictConfig, robot: Any) -> tuple[str, Callable[[str], Rollout]]:
    """What is recorded: its name, and a function that records it under a label."""
    if cfg.policy is None:
        motion = build(cfg.motion)
        gains = {name: _plain(cfg[name]) for name in ("p_gain", "d_gain")}
        return HydraConfig.get().runtime.choices.motion, lambda label: robot.play(motion, **gains, recording=label)
    if not hasattr(robot, "run_policy"):
        raise ValueError("this robot only plays motions; record a policy with robot=emulated or robot=real")
    bundle = PolicyBundle.load(cfg.policy)
    return Path(cfg.policy).name, lambda label: robot.run_policy(bundle, cfg.duration, cycle=cfg.cycle, recording=label)


def _plain(value: Any) -> Any:
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


@hydra.main(version_base="1.3", config_path="../conf", config_name="collect")
def main(cfg: DictConfig) -> None:
    """Compose the robot and the motion, record, save."""
    with one_sentence():
        try:
            collect(cfg)
        except (Stop, Unplugged) as error:
            print(error, file=sys.stderr)
            raise SystemExit(int(getattr(error, "code", ExitCode.PORT))) from None


if __name__ == "__main__":
    main()
