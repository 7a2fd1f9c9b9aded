"""Record a motion on a robot, once or several times.

python experiments/collect.py robot=stand_in motion=squat [world=eta_060] [mount=stand] [repeats=3] [seed=1]
python experiments/collect.py world=random world_seed=7 motion=squat_heldout
python experiments/collect.py motion=chirp_knee mount=stand
python experiments/collect.py -m world=eta_060,eta_070,eta_080
"""

import datetime
import subprocess
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig
from support import one_sentence, plain

from op3.robot import Motion, check_motion
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
    motion, robot = build(cfg.motion), build(cfg.robot)
    check_motion(motion, cfg.mount)
    gains = {name: _own(motion, name) if cfg[name] is None else plain(cfg[name]) for name in ("p_gain", "d_gain")}
    runtime = HydraConfig.get().runtime
    known = {"date": datetime.datetime.now().isoformat(timespec="seconds"), "git_hash": git_hash()}
    folders = []
    for number in range(cfg.repeats):
        name = f"{runtime.choices.motion}-{number}"
        rollout = robot.play(motion, **gains, recording=name)
        rollout = Rollout(rollout.data, rollout.metadata.replace(**known))
        folders.append(rollout.save(Path(runtime.output_dir) / name))
        outcome = "the robot fell" if rollout.metadata.fallen else "the robot stands"
        print(f"{folders[-1]}: {rollout.rows} rows, {rollout.duration:.2f} s, {outcome}")
    return folders


def _own(motion: Motion, name: str) -> Any:
    """A gain of the motion as a robot plays it: one number, or [row, 1] for all joints."""
    gain = np.asarray(getattr(motion, name))
    return gain[:, None] if gain.ndim else float(gain)


def git_hash() -> str | None:
    """The commit of this checkout, None outside one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() or None
    except (OSError, subprocess.CalledProcessError):
        return None


@hydra.main(version_base="1.3", config_path="../conf", config_name="collect")
def main(cfg: DictConfig) -> None:
    """Compose the robot and the motion, record, save."""
    with one_sentence():
        collect(cfg)


if __name__ == "__main__":
    main()
