"""The person at the terminal: only what is said after the question is an answer."""

import os
import pty
import sys
import time

import pytest

from op3.deploy.operator import Console


@pytest.fixture
def keyboard(monkeypatch):
    """Writes what a person types at the terminal that is standard input."""
    person, terminal = pty.openpty()
    with os.fdopen(terminal, encoding="utf-8") as stream:
        monkeypatch.setattr(sys, "stdin", stream)
        yield lambda text: (os.write(person, text.encode()), time.sleep(0.1))
    os.close(person)


def test_an_enter_from_before_the_question_does_not_start_the_robot(keyboard):
    """Enter pressed on the way to the start pose is forgotten; the one after the question counts, once."""
    console = Console()
    keyboard("\n\n")
    said = []
    assert not console.said_go(said.append)
    assert "press Enter" in said[0]
    assert not console.said_go(said.append)
    keyboard("\n")
    assert console.said_go(said.append)
    assert not console.said_go(said.append)
    assert len(said) == 1


def test_a_confirmation_typed_ahead_is_none(keyboard, monkeypatch):
    """Nothing but yes, after the question, confirms."""
    for answer in ("no", "yes"):
        keyboard("yes\n")
        monkeypatch.setattr("builtins.print", lambda *_, answer=answer, **__: keyboard(f"{answer}\n"))
        assert Console().confirm("Move?") == (answer == "yes")
