"""The Hydra sweeper, run as its users run it: a program started from the command line."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import optuna
import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from op3.identify.search_space import StudyError
from op3.identify.storage import open_storage
from op3.identify.sweeper import expand_grid
from tests.scripts import run_script

REPOSITORY = Path(__file__).resolve().parents[2]
APP = Path(__file__).resolve().parent / "toy_app" / "app.py"


def start(folder, *arguments):
    """Start the toy experiment in a folder."""
    path = os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, str(APP), *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def run(folder, *arguments):
    """Run the toy experiment; it must succeed. Returns what it printed."""
    done = run_script(APP, *arguments, place=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def load(folder, name="study"):
    """Open the study that a run has left in its folder."""
    return optuna.load_study(study_name=name, storage=open_storage(folder / "study.journal"))


def points(study):
    """Return parameters and values of all trials, in order."""
    return [(trial.params, trial.values) for trial in study.trials]


def results(folder):
    """Read the results of a run."""
    return yaml.safe_load((folder / "optimization_results.yaml").read_text())


@pytest.mark.parametrize("sampler", ["tpe", "{name: nsga2, population_size: 6}"])
def test_the_same_trials_with_and_without_multirun(sampler, tmp_path):
    """In process or as jobs, the same seed gives the same study, report and results."""
    arguments = ["groups=deep", f"hydra.sweeper.sampler={sampler}", "seed=7"]
    run(tmp_path, *arguments, "hydra.run.dir=single")
    run(tmp_path, "-m", *arguments, "hydra.sweep.dir=multi")
    single, multi = tmp_path / "single", tmp_path / "multi" / "0"
    assert points(load(multi)) == points(load(single))
    assert len(points(load(single))) == 20
    assert results(multi) == results(single) == results(tmp_path / "multi")
    assert (multi / "report.txt").read_text() == (single / "report.txt").read_text() == "study 20\n"


def test_starts_come_from_the_experiment_and_are_kept(tmp_path):
    """In process or as jobs the starts follow the nominal trial, and a file in the folder remembers them."""
    run(tmp_path, "groups=flat", "hydra.sweeper.starts=3", "hydra.run.dir=single")
    run(tmp_path, "-m", "groups=flat", "hydra.sweeper.starts=3", "hydra.sweep.dir=multi")
    single, multi = tmp_path / "single", tmp_path / "multi" / "0"
    assert points(load(multi)) == points(load(single))
    kept = json.loads((single / "starts.json").read_text())
    assert [trial.params for trial in load(single).trials[1:4]] == kept
    assert [start["bowl.x"] for start in kept] == [0.5, 0.51, 0.52]


def test_comma_sweeps_are_a_grid_of_studies(tmp_path):
    """Two seeds by two groups are four studies, each with the parameters of its group."""
    run(tmp_path, "-m", "seed=0,1", "groups=flat,deep")
    studies = results(tmp_path / "out")["studies"]
    assert [study["overrides"] for study in studies] == [
        [f"seed={seed}", f"groups={group}"] for seed in (0, 1) for group in ("flat", "deep")
    ]
    for number, (study, keys) in enumerate(zip(studies, [1, 2, 1, 2], strict=True)):
        folder = tmp_path / "out" / str(number)
        assert study["folder"] == folder.name
        assert len(study["best_params"]) == keys
        assert study["best_value"] == load(folder).best_value
        assert study["best_value"] <= study["nominal_value"]
        assert (folder / "report.txt").exists()
    assert studies[0]["best_params"] != studies[2]["best_params"]


def test_cells_that_share_a_storage_have_studies_of_their_own(tmp_path):
    """One database for the whole grid: what tells the cells apart is in the name."""
    url = f"sqlite:///{tmp_path}/all.db"
    run(
        tmp_path,
        "-m",
        "seed=0,1",
        "groups=flat",
        f"hydra.sweeper.storage='{url}'",
        "hydra.sweeper.study_name=bowl",
        "hydra.sweeper.n_trials=4",
    )
    assert sorted(optuna.get_all_study_names(url)) == ["bowl/seed=0", "bowl/seed=1"]
    assert (tmp_path / "out" / "1" / "report.txt").read_text() == "bowl/seed=1 4\n"


@pytest.mark.parametrize("mode", [["hydra.run.dir=out/0"], ["-m"]])
def test_a_killed_sweep_goes_on_where_it_was(mode, tmp_path):
    """After kill -9, the same command in the same folder keeps all stored trials and ends like any other."""
    process = start(tmp_path, *mode, "seconds=0.05", "hydra.sweeper.n_trials=400")
    journal = tmp_path / "out" / "0" / "study.journal"
    while not (journal.exists() and journal.read_text().count('"op_code":4') > 20):
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    before = points(load(journal.parent))
    assert 16 < len(before) < 400
    total = len(before) + 12
    run(tmp_path, *mode, f"hydra.sweeper.n_trials={total}")
    after = points(load(journal.parent))
    assert after[: len(before)] == before
    assert len(after) == total
    assert len({params["bowl.x"] for params, _ in after}) == total
    assert (journal.parent / "report.txt").read_text() == f"study {total}\n"


def test_jobs_that_die_do_not_end_the_sweep_silently(tmp_path):
    """Where jobs fail before the first trial, the sweep stops and says why."""
    done = run_script(APP, "-m", "fail=start", place=tmp_path)
    assert done.returncode != 0
    assert "The study cannot begin because its first job raised RuntimeError: there is no bowl" in done.stderr


@pytest.mark.parametrize("mode", [[], ["-m"]])
@pytest.mark.parametrize(
    ("argument", "sentence"),
    [
        ("hydra.sweeper.sampler=simplex", "The sampler 'simplex' is unknown"),
        ("+hydra.sweeper.params.bowl.z='interval(0,1)'", "bowl.z: hydra.sweeper.params names a key"),
    ],
)
def test_a_wrong_setting_gets_one_sentence(mode, argument, sentence, tmp_path):
    """The program ends with an error and a sentence, not with a stack trace."""
    done = run_script(APP, *mode, argument, place=tmp_path)
    assert done.returncode != 0
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.rglob("population.json"))


def test_an_interval_on_the_command_line_is_sent_to_the_config():
    """The search space has one place; the message says which line to write there."""
    parsed = OverridesParser.create().parse_overrides(["bowl.x=interval(0,1)"])
    with pytest.raises(StudyError, match=r'`bowl\.x: "interval\(0,1\)"` in hydra\.sweeper\.params'):
        expand_grid(parsed)


def test_a_grid_keeps_lists_quotes_and_additions():
    """What a cell's job gets is what the user wrote."""
    line = ["groups=[motor],[motor,gear]", "+note='a, b'", "~extra", "n=range(0,2)"]
    cells = expand_grid(OverridesParser.create().parse_overrides(line))
    assert cells == [
        [f"groups={groups}", "+note='a, b'", "~extra", f"n={n}"]
        for groups in ("[motor]", "[motor,gear]")
        for n in (0, 1)
    ]
