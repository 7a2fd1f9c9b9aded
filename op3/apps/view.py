"""Show a log, a policy, a model or a diagnosis: in a viewer, or as a video.

op3 view <log> [model=<model.yaml>]               # measured, with a prediction as an overlay
op3 view <policy bundle, or run of op3 train>     # an episode in simulation
op3 view <model.yaml, or run of op3 identify>     # a squat: commands, the model as an overlay
op3 view <robot.yaml>                             # a robot file: a multisine on the stand
op3 view <run of op3 diagnose>                    # measured, before and after the diagnosis
op3 view <log> out=video.mp4                      # or out=log.rrd, out=rerun
op3 view <run of op3 deploy> live=true            # while it runs, with the model as an overlay

Without a screen it writes an mp4.
"""

import os
import sys
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig

from op3.apps.current_run import output_folder
from op3.common.assets import here_or_shipped
from op3.common.settings import read_yaml
from op3.envs import record_episodes
from op3.envs.actors import Watched, find_actor
from op3.motions import multisine, squat
from op3.policy.bundle import MANIFEST, PolicyBundle
from op3.policy.card import find_card
from op3.replay import Replay, simulate_motion
from op3.report.frames import RenderError
from op3.report.live import stretches, summary_line
from op3.report.tracks import SHOWN, Tracks, of_diagnosis, predicted, scene_of
from op3.report.video import write_film
from op3.report.viewer import RATE, pictures, window
from op3.robot import load_robot
from op3.robot.robot_file import FORMAT as ROBOT_FORMAT
from op3.rollout import Rollout, read_logs
from op3.rollout.rollout import METADATA_FILE
from op3.sim import load_model, model_for
from op3.tasks.task import POLICY_PERIOD, find_task

MODEL_FILE = "model.yaml"

LISTED = 8
"""Number of listed folders, if the given folder has several."""


def of_log(cfg: DictConfig) -> Tracks:
    """A log and a model's prediction of it; closed-loop logs have no prediction."""
    logs = [one for log in read_logs(cfg.what, cfg.robot) for one in log.episodes()]
    if not cfg.number < len(logs):
        raise ValueError(f"number={cfg.number}: {cfg.what} has {len(logs)} logs, numbered from 0")
    log = logs[cfg.number]
    shown: dict[str, Rollout] = {"measured": log}
    if log.metadata.policy_rate is not None and log.metadata.mount == "floor":
        print("no simulated overlay: closed-loop commands cannot be replayed open-loop", file=sys.stderr)
        return Tracks(shown, scene_of(log))
    try:
        prediction = Replay([log], num_threads=1).run(model_for(log.robot, cfg.model))[0]
        shown["simulated"] = predicted(prediction)
    except ValueError as error:
        print(f"no simulated overlay: {error}", file=sys.stderr)
    return Tracks(shown, scene_of(log))


def show_card(cfg: DictConfig, path: Path) -> None:
    """Print the card of a policy, or the command that writes one."""
    card = find_card(path)
    print(card.to_yaml() if card else f"{cfg.what} has no card; op3 evaluate policy={cfg.what} card=true writes one")


def of_policy(cfg: DictConfig, path: Path) -> Tracks:
    """An episode of a policy, in the simulation that it was trained in."""
    made = PolicyBundle.load(path).manifest
    show_card(cfg, path)
    task = find_task(made.task)
    actor = find_actor(str(path), task)
    model = cfg.model or made.training.model
    try:
        load_model(model)
    except FileNotFoundError:
        if cfg.model is not None:
            raise
        print(
            f"{model}, on which the policy was trained, was not found; the policy is shown on `paper`", file=sys.stderr
        )
        model = "paper"
    env = actor.environment(task, model, 1, cfg.seed, num_threads=1)
    watched = Watched(actor.policy, env)
    log = record_episodes(env, watched, 1)[0]
    return Tracks({"simulated": log}, env.scene, np.stack(watched.states), 1 / POLICY_PERIOD)


def of_model(cfg: DictConfig) -> Tracks:
    """A squat on the floor: the commands, and the model's simulation of them."""
    if cfg.model is not None:
        raise ValueError(f"model={cfg.model}: {cfg.what} is itself a model; omit model")
    log = simulate_motion(load_model(cfg.what), squat(duration=6.0), mount="floor")
    commanded = {key: log.array(key) for key in log.channels} | {("joint", "position"): log.array("command/position")}
    return Tracks({"commanded": Rollout.from_arrays(commanded, log.metadata), "simulated": log}, scene_of(log))


def of_robot(cfg: DictConfig) -> Tracks:
    """A motion of a robot on the stand: its commands, and the simulation of a model of its servos as an overlay."""
    robot = load_robot(cfg.what)
    log = simulate_motion(model_for(robot, cfg.model), multisine(duration=6.0, robot=robot.reference), mount="stand")
    told = {key: log.array(key) for key in log.channels} | {("joint", "position"): log.array("command/position")}
    return Tracks({"commanded": Rollout.from_arrays(told, log.metadata), "simulated": log}, scene_of(log))


def shown_in(folder: Path) -> list[Path]:
    """Folders of policies, models, diagnoses and logs in a folder, the newest first."""
    marks = [file for name in (MANIFEST, SHOWN, MODEL_FILE, METADATA_FILE) for file in folder.glob(f"**/{name}")]
    found = {mark.parent: mark.stat().st_mtime for mark in marks}
    outer = [place for place in found if found.keys().isdisjoint(place.parents)]
    return sorted(outer, key=lambda place: found[place], reverse=True)


def tracks_of(cfg: DictConfig) -> Tracks:
    """The tracks to show for the given path."""
    path = here_or_shipped(cfg.what)
    for policy in (path, path / "policy"):
        if (policy / MANIFEST).is_file():
            return of_policy(cfg, policy)
    if (path / SHOWN).is_dir():
        return of_diagnosis(path)
    is_yaml = path.suffix in (".yaml", ".yml")
    if path.suffix in (".xml", ".urdf") or (
        is_yaml and path.is_file() and read_yaml(path).get("format") == ROBOT_FORMAT
    ):
        return of_robot(cfg)
    is_model = is_yaml or not path.exists() or (path / MODEL_FILE).is_file()
    below = [] if is_model else shown_in(path)
    if len({place.parent for place in below}) > 1 or not all((place / METADATA_FILE).is_file() for place in below):
        rest = f" and {len(below) - LISTED} more" * (len(below) > LISTED)
        raise ValueError(f"what={cfg.what}: name one of {', '.join(map(str, below[:LISTED]))}{rest}, the newest first")
    return of_model(cfg) if is_model else of_log(cfg)


def watch(cfg: DictConfig, out: Path) -> None:
    """Show a log while it is recorded, in a window, or as one line per second and a final video."""
    if os.path.isfile(cfg.what):
        raise ValueError(f"what={cfg.what}: live=true follows the folder of a log, or of a run of op3 deploy")
    coming = stretches(Path(cfg.what), cfg.model)
    if has_screen() and cfg.out is None:
        window(coming, cfg.joint, cfg.speed)
        return
    seen = []
    for tracks in filter(None, coming):
        print(summary_line(tracks), flush=True)
        seen.append(tracks)
    if not seen:
        raise ValueError(f"what={cfg.what}: contains no recording; start op3 deploy with hydra.run.dir={cfg.what}")
    draw(seen, cfg, out)


def draw(stretches: list[Tracks], cfg: DictConfig, out: Path) -> None:
    """Write a video of all tracks."""
    seconds = sum(tracks.duration for tracks in stretches) / cfg.speed
    print(f"rendering {int(seconds * RATE) + 1} frames ...", file=sys.stderr, flush=True)
    try:
        print(write_film((one for tracks in stretches for one in pictures(tracks, cfg.joint, cfg.speed)), out, RATE))
    except RenderError as error:
        raise ValueError(str(error)) from None


def has_screen() -> bool:
    """Whether a window can be opened."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


INTERRUPTED = "Nothing is kept."


def main(cfg: DictConfig) -> None:
    """Show the tracks, or write them to a file."""
    torch.set_num_threads(1)
    folder = output_folder()
    out = None if cfg.out is None else Path(cfg.out)
    if out is not None and out.name != "rerun" and out.suffix not in (".mp4", ".webp", ".rrd"):
        raise ValueError(f"out must end with .mp4, .webp or .rrd, or be rerun, got {cfg.out}")
    if out is not None and not os.access(next(place for place in out.absolute().parents if place.exists()), os.W_OK):
        raise ValueError(f"out={cfg.out}: nothing can be written there; choose another folder")
    if cfg.live:
        watch(cfg, out or folder / "view.mp4")
        return
    tracks = tracks_of(cfg)
    joints = next(iter(tracks.logs.values())).joints
    if cfg.joint is not None and cfg.joint not in joints:
        raise ValueError(f"joint={cfg.joint}: the log has {', '.join(joints)}")
    if out is not None and (out.name == "rerun" or out.suffix == ".rrd"):
        from op3.report.rerun_recording import record

        print(record(tracks, None if out.name == "rerun" else out) or "shown in rerun")
    elif out is None and has_screen():
        window([tracks], cfg.joint, cfg.speed)
    else:
        draw([tracks], cfg, out or folder / "view.mp4")
