"""One command for all experiments: help, completion, and wrong input answered in one sentence."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from op3.apps import COMMANDS
from op3.apps.command_help import completion, names_in, overview, usage
from op3.command_line import choices_of_resumed, main, quoted
from tests.scripts import run_apart

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def op3() -> Callable[..., tuple[int, str]]:
    """Runs ``op3`` in a folder; gives exit code and standard error."""

    def run(*arguments: str, cwd: Path) -> tuple[int, str]:
        done = run_apart(main, [*arguments], cwd)
        return done.returncode, done.stderr.strip()

    return run


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["trian"], "unknown command 'trian'; the nearest is 'train'"),
        pytest.param(
            ["diagnose", "data=" + 300 * "a"],
            f"data={300 * 'a'}: there is no such file or folder; correct the path",
            id="too-long-for-a-path",
        ),
        (["train", "task=wlak"], "task=wlak: there is no 'wlak' in the group task; the nearest is 'walk'"),
        (
            ["train", "task=walk", "task.rewards={mine: {weight: 1}}"],
            "task.rewards has no field 'mine'; there are alive, command, smooth, bipedal; add an entry with "
            "+task.rewards.mine=...",
        ),
        (["train", "train.stpes=3"], "train has no field 'stpes'; the nearest is 'steps'"),
        (["train", "evaluation={vidoe: true}"], "evaluation has no field 'vidoe'; the nearest is 'video'"),
        (["train", "steps=3"], "there is no setting 'steps'; the nearest is 'train.steps'"),
        (["demo", "diagnose", "effect=dte"], "there is no setting 'effect'; the nearest is 'hidden_effect'"),
        (
            ["demo", "diagnose", "hidden_effect=backlsh"],
            "hidden_effect=backlsh: there is no such effect; the nearest is 'backlash'",
        ),
        (["demo", "diagnose", "hidden_robot=legg"], "hidden_robot must be one of 'leg', 'pendulum', 'op3' or 'arm'"),
        (
            ["collect", "source=model", "mount=stand", "motion=multisine", "robot=arm", "motion.duration=three"],
            "motion.duration=three: must be a number",
        ),
        (["predict", "model=.", "data=."], "the folder . has no model.yaml: give the folder of an identification or"),
        (["collect", "motion=sqat"], "motion=sqat: there is no 'sqat' in the group motion; the nearest is 'squat'"),
        (["collect", "motion.perid=3"], "motion has no field 'perid'; there are knee_low, knee_high,"),
        (
            ["collect", "motion=triangle", "motion.frequency=3"],
            "motion.frequency belongs to another option of its config group",
        ),
        (["collect", "repeats=0"], "repeats must be at least 1, got 0"),
        (["collect", "world_seed=abc"], "world_seed must be a whole number, got 'abc'"),
        (["collect", "plan=plan.yaml"], "there is no file plan.yaml: correct the path"),
        (["collect", "hydra.run.dir=/proc/op3"], "/proc/op3: no such file or directory; choose another folder"),
        (["train", '"seed=3'], "\"seed='3': invalid override; write setting=value"),
        (["doctor", "all"], "doctor takes no settings, got all"),
        (["collect", "twice"], "twice is not a setting: write setting=value"),
        (["demo", "diagnos"], "diagnos is not a setting: write setting=value; the nearest is 'demo diagnose'"),
        (["identify", "effects={dte: {}}"], "effects has no entry 'dte' yet: add it with +effects.dte=..."),
        (
            ["identify", "data=x", "hydra.sweeper.n_trails=5"],
            "hydra.sweeper has no field 'n_trails'; the nearest is 'n_trials'",
        ),
        (["identify", "hydra.sweeper.n_trials=x"], "hydra.sweeper.n_trials=x: Value 'x' of type 'str' could not be"),
        (
            ["identify", "data=x", "seed=1,2"],
            "seed has several values: add -m to run them one after another, or write seed=[",
        ),
        (["identify", "data=x", "hydra.run.dir=run"], "data=x: there is no such file"),
        (["deploy", "--yess"], "unrecognized arguments: --yess; settings are written setting=value, and --help lists"),
        (["predict", "--cfg=all of it"], "argument --cfg/-c: invalid choice: 'all of it' (choose from 'job', 'hydra',"),
        (["predict", "data=3"], "data must be a log, a folder of logs, or a list of them, got 3"),
        (["predict", "data=x", "where=mass"], "where must be a mapping of names to values, got 'mass'"),
        (["predict", "data=x", "~data"], "Key 'data' is not in struct"),
        (["predict", "data=x", "hydra.run.dir=runs/of/mine"], "data=x: there is no such file"),
        (["predict", "data=x", "-m", "hydra.sweep.dir=runs/of/mine", "seed=1"], "Error executing job with overrides"),
        (["transfers", "condition=none", "world=robot_4", "seed=0"], "Error executing job with overrides: ['world="),
        (["identify", "data=x", "joints=[]"], "joints must be a list of length 1 or more, got []"),
        (["identify", "data=x", "refine=null"], "refine must be a mapping of its fields, got None"),
        (["identify", "data=.", "ablate=[dtee]"], "unknown effect 'dtee'; the nearest is 'dte'"),
        (
            ["train", "model=pape"],
            "there is no model file 'pape': give the path of a model.yaml or a name;",
        ),
        (["collect", "p_gain=1000"], "p_gain must be at most 6, got 1000"),
        (["collect", "d_gain=0.69"], "d_gain must be below 0.68 A s/rad, above which the xm430-w350 oscillates"),
        (
            ["collect", "motion=soften", "motion.p_gain=7"],
            "motion 'soften': p_gain must be above 0 and at most 6 A/rad",
        ),
        (["collect", "source=real", "port=[a]"], "port must be text, got ['a']"),
        (["collect", "duration=null"], "duration must be a number, got None"),
        (["deploy", "confirm=maybe"], "confirm must be true or false, got 'maybe'"),
        (["deploy", "policy=hold"], "policy=hold: no such folder; give the folder of a policy bundle"),
        (["deploy", "policy=[x]"], "a path must be text, got ['x']"),
        (["train", "recipe=wlak"], "recipe=wlak: there is no 'wlak' in the group recipe; the nearest is 'walk'"),
        (
            ["design", "robot=spot"],
            "there is no robot 'spot'; there are arm, bench, op3, quadruped; give a name or a path",
        ),
        (["design", "joints=[knee]"], "unknown joint 'knee' of op3; the nearest is 'r_knee'"),
        (["design", "mounts=[table]"], "mounts.0 must be one of 'floor' or 'stand', got 'table'"),
        (["compliance", "policy=stiff", "grounds=[]"], "grounds must be a list of length 1 or more, got []"),
        (["compliance", "policy=stiff", "sizes.episodes=2.5"], "sizes: episodes must be a whole number, got 2.5"),
        (
            ["compliance", "policy=stiff", "baseline=x"],
            "baseline=x: no such folder; give the folder of a policy bundle, hold, zero,",
        ),
        (["evaluate", "policy=hold", "episodes=1000000000"], "not enough memory; use fewer robots"),
        (["collect", "hydra/launcher=slurm"], "hydra/launcher=slurm: there is no 'slurm' in the group hydra/launcher"),
        (
            ["train", "-m", "hydra/launcher=submitit_slurm"],
            "hydra/launcher=submitit_slurm: Slurm (srun) is not installed here",
        ),
        (["predict", "data=x", "joints=r_knee"], "joints must be a list, got 'r_knee'"),
        (["identify", "groups=[motr]"], "groups=motr: there is no 'motr' in the group groups; the nearest is 'motor'"),
        (["predict", "model=", "data=x"], "model is empty: give a model.yaml or a name in assets/models"),
        (["import"], "data is missing: add data=<a log, a folder of logs, or a list of them>"),
        (["import", "runs/8 (2).csv"], "data=runs/8 (2).csv: there is no such file or folder"),
        (["predict", "wandb=maybe", "data=x"], "wandb=maybe: there is no 'maybe' in the group wandb; there are"),
        (["predict", "wandb.mode=maybe", "data=x"], "wandb: mode must be one of 'offline', 'online' or"),
        (["design", "budget=-1"], "budget=-1: there is no '-1' in the group budget; there are demo"),
        (["view", "nothing-here"], "what=nothing-here: no such folder; give a log, a policy bundle, a model.yaml"),
    ],
)
def test_wrong_input_is_answered_in_one_sentence_and_leaves_nothing(op3, arguments, sentence, tmp_path):
    """It names the field and what to write instead; exit code 1."""
    code, said = op3(*arguments, cwd=tmp_path)
    lines = 1 if said.startswith("Error executing job") else 0  # Hydra says which job it was
    assert (code, said[: len(sentence)], said.count("\n")) == (1, sentence, lines)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["--version"],
        ["completion"],
        ["train", "--help"],
        ["trian"],
        ["train", "taks=walk"],
        ["train", "task=wlak"],
        ["train", "-m", "task=wlak", "seed=0,1"],
        ["train", "train.stpes=3"],
        ["train", "model=pape"],
        ["evaluate", "policy=hold", "robot=spot"],
        ["identify", "data=x", "groups=[motr]"],
        ["identify", "data=x"],
        ["diagnose", "data=x"],
        ["collect", "repeats=0"],
        ["predict", "data=x", "wandb=maybe"],
        ["demo", "diagnose", "hidden_robot=legg"],
        ["demo", "diagnose", "hidden_effect=backlsh"],
        ["evaluate", "policy=assets/policies/balanc"],
        ["view", "nothing-here"],
    ],
    ids=" ".join,
)
def test_help_and_wrong_names_are_answered_before_heavy_imports(arguments, tmp_path):
    """In an interpreter of its own: neither torch nor MuJoCo is imported, which take seconds."""
    code = (
        "import sys\nfrom op3.command_line import main\n"
        "try:\n    main(sys.argv[1:])\nfinally:\n"
        "    assert not {'torch', 'mujoco', 'numba', 'optuna', 'plotly'} & set(sys.modules), 'imported'"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr, done.stderr
    assert not list(tmp_path.iterdir())


def test_an_import_that_is_refused_writes_nothing(op3, tmp_path):
    """Neither beside the log, nor where the robot is unknown."""
    (tmp_path / "log.csv").write_text("time,a.target,a.position\n0,0,0\n0.01,0,0\n")
    assert op3("import", "log.csv", "robot=spot", cwd=tmp_path)[1].startswith("there is no robot 'spot'")
    assert [path.name for path in tmp_path.iterdir()] == ["log.csv"]


def test_a_run_begins_in_the_folder_of_another(op3, tmp_path):
    """What lies in the working folder is not what the run would write over."""
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "hydra.yaml").write_text("hydra:\n  job:\n    name: identify\n")
    assert op3("predict", "data=x", cwd=tmp_path)[1].startswith("data=x: there is no such file")


def test_an_interruption_before_the_work_begins_is_one_word(monkeypatch, capsys):
    """Ctrl-C while modules are imported leaves no stack trace; exit code 130."""

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("op3.apps.job.check_first_job", interrupted)
    monkeypatch.setattr(sys, "argv", sys.argv)
    with pytest.raises(SystemExit, match="130"):
        main(["train", "-m", "seed=0,1"])
    assert capsys.readouterr().err == "\nInterrupted.\n"


def test_the_folder_of_another_command_is_not_written_over(op3, tmp_path):
    """Pages and results of all commands have the same names; a refused command leaves the record of the run there."""
    record = tmp_path / "run" / ".hydra" / "hydra.yaml"
    record.parent.mkdir(parents=True)
    record.write_text("hydra:\n  job:\n    name: identify\n")
    refused = (1, "run is the folder of a run of identify, which would be overwritten: choose another hydra.run.dir")
    assert op3("predict", "data=x", "hydra.run.dir=run", cwd=tmp_path) == refused
    assert op3("predict", "-m", "data=x", "hydra.run.dir=run", cwd=tmp_path) == refused
    assert op3("identify", "data=x", "hydra.run.dir=run", cwd=tmp_path)[1].startswith("data=x: there is no such file")
    assert record.read_text() == "hydra:\n  job:\n    name: identify\n"


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ("seed=0,1,2", "seed=0,1,2"),
        ("groups=[motor,friction]", "groups=[motor,friction]"),
        ("data=a b(1).csv", "data='a b(1).csv'"),
        ("budgets.demo.train=[train.steps=3,seed=1]", "budgets.demo.train=['train.steps=3','seed=1']"),
        ("data=it's.csv", r"data='it\'s.csv'"),
        ("-m", "-m"),
    ],
)
def test_only_what_hydra_cannot_read_is_quoted(given, read):
    """Sweeps and lists stay what they are."""
    assert quoted(given) == read


def test_a_file_that_looks_like_a_sweep_is_a_file(tmp_path):
    """A name with a comma is one path where it exists."""
    path = tmp_path / "a,b.csv"
    path.touch()
    assert quoted(f"data={path}") == f"data='{path}'"


def test_help_tells_settings_with_units_and_groups():
    """The settings come with their defaults and comments, without Hydra's own; groups with the names in them."""
    text = usage("train")
    assert text.startswith("Train a policy on a simulated robot.\n\nop3 train task=balance|walk")
    assert "initial_gain: 3.0  # P gain of the untrained policy, A/rad" in text
    assert "# logs to fit: a path, a folder, a pattern or a list of them\ndata: ???" in usage("identify")
    assert "task=  " in text
    assert "walk_terrain" in text
    assert "job_logging" not in text


@pytest.fixture(scope="module")
def completed() -> Callable[[str], list[str]]:
    """What the function of bash offers for a line."""
    function = completion()

    def offer(line: str) -> list[str]:
        call = f'COMP_LINE="{line}"; COMP_POINT={len(line)}; COMP_WORDS=({line}); COMP_CWORD={len(line.split()) - 1}'
        text = f'{function}\n{call}\n_op3; printf "%s\\n" "${{COMPREPLY[@]}}"'
        done = subprocess.run(["bash"], input=text, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout.split()

    return offer


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("op3 dem", "demo"),
        ("op3 demo di", "diagnose"),
        ("op3 train task=walk_t", "walk_terrain"),
        ("op3 identify effect=[backl", "[backlash]"),
        ("op3 identify groups=[gea", "[gear]"),
        ("op3 train initial_g", "initial_gain="),
    ],
)
def test_completion_knows_commands_settings_and_names(completed, line, offered):
    """Names are those of files and of the catalogue; bash takes `=` for the end of a word, so only values are given."""
    assert offered in completed(line)


def test_every_command_is_listed():
    """The overview has a line for each, with the first line of its documentation."""
    text = overview()
    assert all(f"  {name} " in text for name in COMMANDS)


def test_the_doctor_looks_at_this_machine():
    """In a process of its own: cores, Python and rendering are told, whatever they are."""
    command, environment = [sys.executable, "-m", "op3", "doctor"], {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0
    for topic in ("Python", "cores", "rendering", "disk", "robot"):
        assert topic in done.stdout


def test_a_resumed_run_has_the_groups_that_it_chose(tmp_path):
    """Groups that are not given are those of the run, so that a setting of its task can be overridden."""
    folder = tmp_path / "run"
    (folder / ".hydra").mkdir(parents=True)
    choices = {"budget": "laptop", "algorithm": "sac", "task": "walk_command", "recipe": "null", "wandb": "disabled"}
    saved = yaml.safe_dump({"hydra": {"runtime": {"choices": choices}}})
    (folder / ".hydra" / "hydra.yaml").write_text(saved)
    words = ["train.steps=10", f"resume={folder}", "budget=demo"]
    assert sorted(choices_of_resumed(words)) == ["algorithm=sac", "recipe=null", "task=walk_command"]
    assert choices_of_resumed(["train.steps=10"]) == []
    assert choices_of_resumed(["resume=/nowhere"]) == []


def test_no_setting_has_the_name_of_a_group():
    """Hydra would read it as a choice of the group, and refuse it."""
    contents = {app: yaml.safe_load((ROOT / "conf" / f"{app}.yaml").read_text()) for app in COMMANDS.values()}
    groups = {name for name in set().union(*contents.values()) - {"defaults", "hydra"} if names_in(name)}
    for app, content in contents.items():
        chosen = {name for entry in content["defaults"] if isinstance(entry, dict) for name in entry}
        assert not groups & set(content) - chosen, app
