"""The page that a person reads before the first power-on says what the code does."""

import re
import signal
from pathlib import Path

from op3.deploy.exit_codes import ExitCode
from op3.deploy.start_checks import UNTOUCHED, StartChecks

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "deploy.md").read_text(encoding="utf-8")


def test_every_exit_code_is_explained():
    """The page states each code with its name, and no other code."""
    named = {int(code): name for code, name in re.findall(r"\b(\d+) `([A-Z_]+)`", PAGE)}
    signals = {128 + number for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM)}
    assert named == {int(code): code.name for code in ExitCode if int(code) not in signals}
    assert all(str(code) in PAGE for code in signals)


def test_every_start_check_has_a_remedy():
    """Whatever check fails, the list of the page begins an entry with its name."""
    names = re.findall(r'\("([a-zA-Z -]+)", self\._\w+\)', Path(StartChecks.run.__code__.co_filename).read_text())
    assert len(set(names)) >= 12
    for name in names:
        assert re.search(rf"^- (?:`[^`]*`, )*`{name}", PAGE, re.MULTILINE), name
    for register in UNTOUCHED:
        assert f"`{register.replace('_', ' ')}" in PAGE, register
