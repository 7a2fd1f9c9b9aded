"""Real launchers, many processes and hard kills: what a cluster does to a study."""

import importlib.util
import json
import os
import random
import signal
import time

import pytest
from test_sweeper import load, points, run, start


def installed(launcher: str) -> bool:
    """Whether a Hydra launcher can be used."""
    if importlib.util.find_spec("hydra_plugins") is None:
        return False
    return importlib.util.find_spec(f"hydra_plugins.hydra_{launcher}_launcher") is not None


LAUNCHERS = [
    pytest.param(
        ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
        marks=pytest.mark.skipif(not installed("joblib"), reason="hydra-joblib-launcher is not installed"),
        id="joblib",
    ),
    pytest.param(
        ["hydra/launcher=submitit_local", "hydra.launcher.cpus_per_task=1", "hydra.launcher.timeout_min=5"],
        marks=pytest.mark.skipif(not installed("submitit"), reason="hydra-submitit-launcher is not installed"),
        id="submitit_local",
    ),
]


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_a_launcher_gives_the_trials_of_one_process(launcher, tmp_path):
    """Two populations side by side as two real jobs: the same trials, other processes, and the report at the end."""
    arguments = ["hydra.sweeper.parallel_populations=2", "hydra.sweeper.n_trials=8", "hydra.sweeper.population=4"]
    run(tmp_path, "-m", *launcher, *arguments)
    run(tmp_path, *arguments, "hydra.run.dir=single")
    study, folder = load(tmp_path / "out" / "0"), tmp_path / "out" / "0"
    assert points(study) == points(load(tmp_path / "single"))
    assert len({trial.user_attrs["pid"] for trial in study.trials}) == 2
    assert (folder / "report.txt").read_text() == "study 8\n"
    jobs = {entry.name for entry in (folder / "populations").iterdir() if entry.name.isdigit()}
    assert jobs == {"0", "1"}


@pytest.mark.slow
def test_four_processes_on_one_journal(tmp_path):
    """Four programs on one journal file: all trials are stored once, none is asked twice, each has worked."""
    arguments = ["seconds=0.3", "hydra.sweeper.n_trials=96", "hydra.sweeper.population=4"]
    arguments.append(f"hydra.sweeper.storage={tmp_path / 'shared.journal'}")
    programs = [start(tmp_path, *arguments, f"hydra.run.dir=run{i}", f"hydra.sweeper.worker={i}") for i in range(4)]
    for program in programs:
        output, _ = program.communicate(timeout=300)
        assert program.returncode == 0, output
    shared = tmp_path / "shared"
    shared.mkdir()
    os.link(tmp_path / "shared.journal", shared / "study.journal")
    trials = load(shared).trials
    assert 96 <= len(trials) <= 96 + 3 * 4
    assert len({trial.params["bowl.x"] for trial in trials}) == len(trials)
    assert len({trial.user_attrs["worker"] for trial in trials}) == 4
    assert all((tmp_path / f"run{i}" / "report.txt").exists() for i in range(4))


@pytest.mark.slow
def test_five_kills_lose_nothing_but_what_is_in_flight(tmp_path):
    """After each of five kill -9 at random moments the stored trials are as before; the end is that of one run."""
    arguments = ["-m", "seconds=0.1", "hydra.sweeper.n_trials=96", "hydra.sweeper.population=4"]
    rng, folder = random.Random(0), tmp_path / "out" / "0"
    stored: list = []
    for _ in range(5):
        program = start(tmp_path, *arguments)
        # long enough for the program to start; then anywhere between two populations or within one
        begun, enough = time.monotonic(), len(stored) + 4
        while time.monotonic() - begun < 60 and finished(folder) < enough:
            assert program.poll() is None, program.communicate()[0]
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, 0.5))
        program.send_signal(signal.SIGKILL)
        program.communicate()
        now = points(load(folder))
        assert now[: len(stored)] == stored
        assert len(now) > len(stored)
        stored = now
    assert len(stored) < 96
    run(tmp_path, *arguments)
    after = points(load(folder))
    assert after[: len(stored)] == stored
    assert len(after) == 96
    assert len({params["bowl.x"] for params, _ in after}) == 96
    jobs = (folder / "populations").glob("*/population.json")
    asked = [trial["bowl.x"] for job in jobs for trial in json.loads(job.read_text())]
    # a population that was in flight when the program died is evaluated once more, or replaced
    assert len(asked) - 96 <= 5 * 4
    uninterrupted = tmp_path / "whole"
    run(tmp_path, *arguments[1:], f"hydra.run.dir={uninterrupted}")
    assert points(load(uninterrupted)) == after


def finished(folder) -> int:
    """Trials that the journal of a folder holds as finished."""
    journal = folder / "study.journal"
    return len(load(folder).get_trials(deepcopy=False)) if journal.exists() and journal.stat().st_size > 2000 else 0
