"""The figures of a policy for documents: learning curves, commands over the gait, snapshots and films.

python experiments/policy_figures.py policy=assets/policies/walk
python experiments/policy_figures.py policy=<bundle> tasks=[walk_bricks_c,walk_push] \\
    'trainings={walk: [<run of seed 0>, <run of seed 1>], balance: [<run>]}'

Needs what `pip install "op3[docs]"` installs. Pictures lie in `folder`, ready for a document in Markdown.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from drawing import panels, small_film, strip, told
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from omegaconf import DictConfig

from op3.apps.fields import check_given, plain, positive, whole
from op3.apps.job import one_sentence
from op3.envs import record_episodes
from op3.envs.actors import Watched, find_actor
from op3.report import read_result
from op3.report.frames import RenderError, draw_frames
from op3.report.style import PALETTE, words
from op3.robot import load_robot
from op3.rollout import Rollout
from op3.tasks.behaviour import GaitProfile, gait_profile
from op3.tasks.task import TICKS, find_task

FRAME_EVERY, SIZE = 6, (360, 360)
"""Policy steps between two frames of a film, and their height and width [pixel]."""
SHOWN = 6
"""Snapshots side by side."""
BETWEEN = 4
"""Frames between two of them: what comes in between is a step or so."""


def learning(trainings: Mapping[str, Sequence[str]], path: Path) -> Path:
    """Return without exploration over the steps, a panel per task and a line per run."""
    figure, grid = panels(1, len(trainings), width=4.2 * len(trainings), squeeze=False)
    for axes, (task, folders) in zip(grid[0], trainings.items(), strict=True):
        for folder, colour in zip(folders, PALETTE, strict=False):
            run = read_result(Path(folder) / "result.yaml")
            steps, returns = np.array(run["learning.steps"]), run["learning.return"]
            axes.plot(steps / 1e6, returns, color=colour, label=Path(folder).name)
        axes.set(title=words(task), xlabel="steps [million]", ylabel="return [-]")
        axes.legend()
    return keep(figure, path)


def gait(profile: GaitProfile, joint: str, path: Path) -> Path:
    """Target angle and P gain of a joint over the gait, the phase in which its foot carries shaded."""
    figure, grid = panels(2, 1, 4.2, 5.6, sharex=True)
    lines = (
        (profile.target, profile.target_deviation, "target angle [rad]"),
        (profile.gain, profile.gain_deviation, "P gain [A/rad]"),
    )
    for axes, (mean, deviation, label) in zip(grid, lines, strict=True):
        shade(axes, profile)
        axes.plot(profile.phase, mean, color=PALETTE[0])
        axes.fill_between(profile.phase, mean - deviation, mean + deviation, color=PALETTE[0], alpha=0.2, lw=0)
        axes.set_ylabel(label)
    grid[0].set_title(f"{words(joint)}, support shaded")
    grid[1].set_xlabel("phase of the gait [cycles]")
    return keep(figure, path)


def shade(axes: Axes, profile: GaitProfile) -> None:
    """Mark the bins in which the foot carries."""
    half = 0.5 / len(profile.phase)
    for phase in profile.phase[profile.stance]:
        axes.axvspan(phase - half, phase + half, color="0.5", alpha=0.15, lw=0)


def keep(figure: Any, path: Path) -> Path:
    """Write a figure; the same data give the same bytes."""
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
    return path


def play(cfg: DictConfig, name: str, episodes: int) -> tuple[list[Rollout], Any, np.ndarray]:
    """Episodes of a task, its scene, and the states [frame, nq] of the first one."""
    task = find_task(name)
    actor = find_actor(cfg.policy, task)
    env = actor.environment(task, cfg.model, episodes, cfg.seed)
    watched = Watched(actor.policy, env)
    logs = record_episodes(env, watched, episodes)
    return logs, env.scene, np.stack(watched.states[: logs[0].rows // TICKS])


def snapshots(scene: Any, states: np.ndarray, path: Path) -> Path:
    """Some moments from the middle of an episode, side by side."""
    middle = len(states) // 2
    picture = strip(draw_frames(scene.compile(), states[middle : middle + SHOWN * BETWEEN : BETWEEN]))
    picture.resize((picture.width * 2 // 3, picture.height * 2 // 3)).save(path, quality=80)
    return path


def film(scene: Any, states: np.ndarray, path: Path, rate: float, follow: bool) -> Path:
    """A film of states at a rate [Hz]."""
    return small_film(draw_frames(scene.compile(), states, follow=follow, size=SIZE), path, rate)


def run(cfg: DictConfig) -> None:
    """Draw all that is asked for."""
    torch.set_num_threads(1)
    check_given(cfg, "policy", "folder of a bundle")
    whole(cfg, "seed", 0)
    whole(cfg, "episodes", 1)
    seconds = positive(cfg, "film_seconds", "s")
    if cfg.joint not in (controlled := load_robot("op3").controlled):
        raise ValueError(f"joint={cfg.joint}: choose {', '.join(controlled)}")
    folder = Path(cfg.folder)
    folder.mkdir(parents=True, exist_ok=True)
    label = Path(cfg.policy).name
    made = [learning(plain(cfg.trainings), folder / "learning.svg")] if cfg.trainings else []
    for task in plain(cfg.tasks):
        walks = find_task(task).cycle is not None
        logs, scene, states = play(cfg, task, cfg.episodes if task == cfg.tasks[0] else 1)
        if walks and task == cfg.tasks[0]:
            made.append(gait(gait_profile(logs, task, cfg.joint), cfg.joint, folder / f"{label}_gait.svg"))
        rate = logs[0].metadata.policy_rate or 0.0
        shown = states[len(states) // 2 :][: round(seconds * rate) : FRAME_EVERY]
        try:
            made.append(snapshots(scene, states, folder / f"{task}.jpg"))
            made.append(film(scene, shown, folder / f"{task}.webp", rate / FRAME_EVERY, follow=walks))
        except RenderError as error:
            print(f"no pictures: {error}")
    print(*map(told, made), sep="\n")


@hydra.main(config_path="../conf", config_name="policy_figures", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Draw."""
    with one_sentence():
        run(cfg)


if __name__ == "__main__":
    main()
