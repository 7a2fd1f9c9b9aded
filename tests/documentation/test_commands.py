"""Every command of README.md and docs/ is one that the scripts, with their configs, take."""

import argparse
import re
import runpy
import shutil
import subprocess
import sys
from itertools import zip_longest
from pathlib import Path

import pytest
from documented import PAGES, ROOT, STANDS_FOR, Command, commands, files
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser

from op3.command_line import main
from op3.common.private import CLAIMED

MAKES = re.compile(r"(?:^|[._])(dir|out|record|frames|storage)$")
"""Settings that name what a command writes."""


ELSEWHERE = [
    "pip",
    "python3",
    ".",
    "echo",
    "sudo",
    "systemctl",
    "chrt",
    "ssh",
    "scp",
    "apt",
    "usermod",
    "wandb",
    "optuna-dashboard",
]
"""The shell's own commands, and programs of the reader's machine or robot, which need not be on this one."""


class Accepted(BaseException):
    """A script has taken its arguments; the work would begin here."""


@pytest.fixture
def accept(monkeypatch, tmp_path):
    """Let a script come to where its work begins: to its composed config, or its parsed arguments."""
    parse_args = argparse.ArgumentParser.parse_args

    def parse(self, *given):
        parsed = parse_args(self, *given)
        if sys._getframe(1).f_globals["__name__"] == "__main__":
            raise Accepted
        return parsed

    def run_hydra(args, task_function, config_path, config_name, **_):
        folder = Path(config_path)
        if not folder.is_absolute():  # of a script that stands beside `conf`
            folder = (Path(task_function.__code__.co_filename).parent / config_path).resolve()
        jobs = variants(args.overrides)
        for overrides in jobs:
            GlobalHydra.instance().clear()
            with initialize_config_dir(str(folder), version_base="1.3"):
                config = compose(config_name, overrides, return_hydra_config=True)
            assert args.multirun or len(jobs) == 1 or config.hydra.mode, "several values take -m"

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    monkeypatch.setattr(sys.modules["hydra.main"], "_run_hydra", run_hydra)
    monkeypatch.setattr(sys, "path", [str(ROOT / "experiments"), *sys.path])
    monkeypatch.setenv(CLAIMED, "")  # set first, so that it is gone again after the test
    monkeypatch.delenv(CLAIMED)
    monkeypatch.chdir(tmp_path)
    for name in ("assets", "conf"):
        (tmp_path / name).symlink_to(ROOT / name)


def variants(overrides: list[str]) -> list[list[str]]:
    """What a multirun's jobs get: every value of every sweep at least once."""
    columns = []
    for override in OverridesParser.create().parse_overrides(overrides):
        name, value = override.input_line.split("=", 1)
        sweep = override.is_sweep_override() and not override.is_hydra_override()
        columns.append([f"{name}={one}" for one in override.sweep_string_iterator()] if sweep else [f"{name}={value}"])
    longest = max(map(len, columns), default=1)
    return [list(row) for row in zip_longest(*(c + c[-1:] * (longest - len(c)) for c in columns))] or [[]]


def start(command: Command, monkeypatch) -> None:
    """Start a command of this project, as the shell would, up to where its work begins."""
    words = list(command.words[1:])
    script = command.script
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # as `launch` sets it, and here only as long as the test
    if script and not re.search("argparse|hydra.main|launch", script.read_text(encoding="utf-8")):
        assert not words[1:], f"{script.name} takes no arguments"
    elif command.words[0] == "op3":
        main(words)
    else:
        monkeypatch.setattr(sys, "argv", [str(script), *words[1:]])
        runpy.run_path(str(script), run_name="__main__")


def unmade(command: Command, made: set[str]) -> list[str]:
    """Files that a command reads, and that neither the checkout has nor a command above it made."""
    words = [word.partition("=") for word in command.words if "=" in word]
    named = {part for name, _, value in words if not MAKES.search(name) for part in re.findall(r"[^\s,\[\]']+", value)}
    named = {
        f for f in named if re.search(r"/|\.(yaml|csv|npz|xml|txt)$", f) and not re.match(r"/dev/|\w+://|/shared/", f)
    }
    made |= {value for name, _, value in words if MAKES.search(name)}
    known = {*STANDS_FOR.values(), *made}
    return [f for f in named if not (ROOT / f).exists() and not any(f == k or f.startswith(k + "/") for k in known)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_a_page_is_one(page, accept, monkeypatch, capsys):
    """Overrides compose, arguments parse, files exist, targets of make are there; what else a shell runs is shell."""
    wrong: list[str] = []
    made = set(files(page))
    for command in commands(page):
        try:
            if command.ours:
                start(command, monkeypatch)
            elif command.words[0] == "make":
                subprocess.run(["make", "-n", "-C", str(ROOT), *command.words[1:]], check=True, capture_output=True)
            else:
                assert shutil.which(command.words[0]) or command.words[0] in ELSEWHERE, "no such program"
            assert not (lacking := unmade(command, made)), f"there is no {', '.join(lacking)}"
        except Accepted:
            pass
        except (Exception, SystemExit) as error:
            said = capsys.readouterr().err.strip() or str(error)
            wrong.append(f"{command}\n  {said}")
    assert not wrong, "\n".join(wrong)
