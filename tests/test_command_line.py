"""One command for all experiments: help, completion, and wrong input answered in one sentence."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from op3.command_line import COMMANDS, completion, quoted, script, usage

ROOT = Path(__file__).resolve().parents[1]


def op3(*arguments: str, cwd: Path = ROOT) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "op3", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False, env=_environment())


def _environment() -> dict[str, str]:
    import os

    return {**os.environ, "PYTHONPATH": str(ROOT)}


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["trian"], "op3 has no command 'trian'; the nearest is 'train'"),
        (["train", "task=wlak"], "task=wlak: there is no such file in conf/task; the nearest is 'walk'"),
        (["train", "train.stpes=3"], "there is no setting 'train.stpes'; the nearest is 'train.steps'"),
        (["train", "practice={mirored: 1}"], "practice has no part 'mirored'; the nearest is 'mirrored'"),
        (["demo", "diagnose", "efect=dte"], "there is no setting 'efect'; the nearest is 'effect'"),
        (["collect", "motion=sqat"], "motion=sqat: there is no such file in conf/motion; the nearest is 'squat'"),
    ],
)
def test_misspelt_names_are_answered_with_the_nearest(arguments, sentence, tmp_path):
    """One sentence on standard error, exit code 1, and nothing written."""
    done = op3(*arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.strip() == sentence
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_viewed_is_said_in_one_sentence(tmp_path):
    """The word after `view` is what is to be seen, whatever it is."""
    done = op3("view", "nothing-here", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("what=nothing-here: there is no such file or folder; give a log, a policy bundle")
    assert done.stderr.count("\n") == 1


def test_a_path_may_have_any_character(tmp_path):
    """A file whose name holds a blank, an equals sign and parentheses is looked for by that name."""
    done = op3("predict", "model=paper", "data=runs/kp=8 (2).csv", cwd=tmp_path)
    assert done.returncode == 1
    assert "kp=8 (2).csv" in done.stderr
    assert "Traceback" not in done.stderr


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
    text = usage("train", "Train.")
    assert text.startswith("Train.")
    assert "initial_gain: 3.0  # A/rad" in text
    assert "task=  " in text
    assert "walk_terrain" in text
    assert "job_logging" not in text


@pytest.fixture(scope="module")
def completed() -> Callable[[str], list[str]]:
    """What the function of bash offers for a line."""
    function = completion({name: script(name) for name in COMMANDS if script(name).is_file()})

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
    """The overview has a line for each, with what its script says of itself."""
    done = op3("--help")
    assert done.returncode == 0
    for name in COMMANDS:
        if script(name).is_file():
            assert f"  {name} " in done.stdout


def test_the_doctor_looks_at_this_machine():
    """Cores, Python and rendering are told, whatever they are."""
    done = op3("doctor")
    assert done.returncode == 0
    for topic in ("Python", "cores", "rendering", "disk", "robot"):
        assert topic in done.stdout
