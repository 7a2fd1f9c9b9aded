"""The commands of the pages run, one after the other, as a reader types them, at budgets of seconds."""

import multiprocessing
import os
import runpy
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from documented import PAGES, ROOT, Command, commands, files
from hydra.core.override_parser.overrides_parser import OverridesParser

from op3.command_line import main
from op3.envs import BatchedEnv, record_episodes
from op3.motions import squat
from op3.policy import PolicyBundle
from op3.replay import simulate_motion
from op3.rollout import Rollout
from op3.sim import load_model, save_model
from op3.tasks.task import find_task

SEARCH = "hydra.sweeper.n_trials=4 hydra.sweeper.population=4 wandb=disabled"
SMALL = {
    "collect": "repeats=1 confirm=false",
    "compare_runs": "",
    "deploy": "duration=1 confirm=false panel=false pose=stand",  # in which the emulated robot hangs
    "design_excitation": "seconds=10 motions=[squat]",
    "diagnose": "windows=12 without=[backlash,compliance,lugre] episodes=2 wandb=disabled",
    "emulate_robot": "duration=0.2",
    "evaluate": "episodes=1 video=false baseline=null card=false",
    "identify": f"{SEARCH} refine.rounds=0 refine.polish=0 refine.starts=0",
    "import_log": "",
    "predict": "wandb=disabled",
    "reidentify": f"{SEARCH} hydra.sweeper.starts=2 repeats=2 finalists=1 processes=1",
    "train": "environments=4 algorithm.hidden=[16,16] algorithm.batch=32 train.steps=320 algorithm.warmup=128 "
    "train.log_every=64 train.evaluate_every=160 evaluation.episodes=1 evaluation.video=false wandb=disabled",
}
"""What makes a script quick. Those that are not here take minutes at any budget; they are only composed."""

REAL_ROBOT = {"source=real": "source=emulated", "port=/dev/ttyUSB0": "port=emulated"}
"""What stands in for the robot on the reader's table."""

SERVERS = multiprocessing.get_context("forkserver")
"""Starts commands from a process that has imported the library once."""
SERVERS.set_forkserver_preload(["op3.command_line", "op3.envs", "op3.identify.identification", "op3.report"])


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> Path:
    """What the placeholders of the pages stand for: short logs (a diagnosis wants 2 s), models, two episodes."""
    folder, model, noise = tmp_path_factory.mktemp("given"), load_model("paper"), np.random.default_rng(3)
    for name in ("model", "other_model"):
        save_model(model, folder / f"{name}.yaml")
    for name, frequency in (("log", 1.0), ("other_log", 0.7)):
        simulate_motion(model, squat(frequency=frequency, duration=1.0)).save(folder / name)
    for number, frequency in enumerate((0.4, 0.7, 1.0)):
        log = simulate_motion(model, squat(frequency=frequency, duration=2.1), mount="stand")
        arrays = {k: log.array(k)[:, 14:] if k[0] in ("joint", "command") else log.array(k) for k in log.channels}
        arrays["joint", "position"] += noise.normal(0, 6e-4, arrays["joint", "position"].shape)
        metadata = log.metadata.replace(joints=log.joints[14:], recording=f"squat_{number}")
        Rollout.from_arrays(arrays, metadata).save(folder / "logs" / f"squat_{number}")
    policy = PolicyBundle.load(ROOT / "assets" / "policies" / "balance")
    env = BatchedEnv(find_task("balance_eval"), model, 2, 3, action_map=policy.manifest.action_map)
    for number, log in enumerate(record_episodes(env, policy)):
        log.save(folder / "episodes" / f"episode-{number}")
    return folder


def small(command: Command) -> list[str]:
    """The words of a command: a robot that is there, the first value of every sweep, and the budget of its script."""
    words = [REAL_ROBOT.get(word, word) for word in command.words]
    for number, word in enumerate(words):
        if "=" in word and not word.startswith("hydra"):
            (override,) = OverridesParser.create().parse_overrides([word])
            if override.is_sweep_override():
                words[number] = f"{word.partition('=')[0]}={next(iter(override.sweep_string_iterator()))}"
    assert command.script is not None
    return [*words, *SMALL[command.script.stem].split()]


def act(words: list[str], folder: str, said: str) -> None:
    """Be the process of a command."""
    os.chdir(folder)
    with open(said, "wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.environ.update(OMP_NUM_THREADS="1", WANDB_MODE="disabled", PYTHONPATH=str(ROOT))
    sys.path.insert(0, folder)
    if words[0] == "op3":
        main(words[1:])
    else:
        sys.argv = words[1:]
        sys.path.insert(0, str(Path(words[1]).resolve().parent))
        runpy.run_path(words[1], run_name="__main__")


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_commands_of_a_page_end_as_it_says(page, given, tmp_path):
    """From top to bottom in one folder, so that what one makes the next one finds."""
    for name in ("assets", "conf", "experiments"):
        (tmp_path / "work" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "work" / name).symlink_to(ROOT / name)
    shutil.copytree(given, tmp_path / "work" / "given")
    (tmp_path / "shared").symlink_to(ROOT.parent / "shared")
    for name, text in files(page).items():
        file = tmp_path / "work" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    wrong = []
    for command in commands(page):
        argued = any("=" in word for word in command.words)
        if not argued or command.script is None or command.script.stem not in SMALL:
            continue
        if any(
            word.partition("=")[2].startswith("../") and not (ROOT / word.partition("=")[2]).exists()
            for word in command.words
        ):
            continue  # a log that is not on this machine
        if "hydra/launcher=submitit_slurm" in command.words and shutil.which("srun") is None:
            continue
        process = SERVERS.Process(target=act, args=(small(command), str(tmp_path / "work"), str(tmp_path / "said")))
        began = time.monotonic()
        process.start()
        process.join(600)
        process.kill()
        print(f"{time.monotonic() - began:6.1f} s  {command}", flush=True)
        if process.exitcode != command.code:
            wrong.append(f"{command}\n  exit code {process.exitcode}: {(tmp_path / 'said').read_text()[-800:]}")
    assert not wrong, "\n".join(wrong)
