"""The page that a person reads before the first power-on says what the code does."""

import re
from pathlib import Path

from op3.deploy.exit_codes import ExitCode
from op3.deploy.start_checks import UNTOUCHED, StartChecks

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "deploy.md").read_text(encoding="utf-8")


def test_every_exit_code_is_explained():
    """Each code stands in the tables of the page, and no other number is called a code there."""
    rows = [line for line in PAGE.splitlines() if line.startswith("|")]
    told = {int(number) for row in rows for number in re.findall(r"\b\d+\b", row.replace("20 to 28", "20 28"))}
    assert {int(code) for code in ExitCode} <= told
    named = dict(re.findall(r"^\| (\d+) \| `([A-Z_]+)`", PAGE, re.MULTILINE))
    assert {int(code): name for code, name in named.items()} == {int(ExitCode[name]): name for name in named.values()}


def test_every_start_check_has_a_remedy():
    """Whatever check fails, the table of the page has a line that begins with its name."""
    names = re.findall(r'\("([a-zA-Z -]+)", self\._\w+\)', Path(StartChecks.run.__code__.co_filename).read_text())
    assert len(set(names)) >= 12
    for name in names:
        assert re.search(rf"^\| `{name}", PAGE, re.MULTILINE), name
    for register in UNTOUCHED:
        assert f"`{register.replace('_', ' ')}" in PAGE, register
