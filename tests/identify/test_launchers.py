"""Real launchers, many processes and hard kills: what a cluster does to a study."""

import importlib.util

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
    process = start(tmp_path, "-m", *launcher, *arguments)  # of its own: joblib's workers end with their interpreter
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    run(tmp_path, *arguments, "hydra.run.dir=single")
    study, folder = load(tmp_path / "out" / "0"), tmp_path / "out" / "0"
    assert points(study) == points(load(tmp_path / "single"))
    assert len({trial.user_attrs["pid"] for trial in study.trials}) == 2
    assert (folder / "report.txt").read_text() == "study 8\n"
    jobs = {entry.name for entry in (folder / "populations").iterdir() if entry.name.isdigit()}
    assert jobs == {"0", "1", "2"}  # what the study begins with, and two populations
