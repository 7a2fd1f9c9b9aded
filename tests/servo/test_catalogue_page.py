"""The page of the catalogue says what the classes say."""

import runpy
from pathlib import Path

import pytest

from op3.servo import catalogue

REPOSITORY = Path(__file__).resolve().parents[2]
SCRIPT = REPOSITORY / "experiments" / "write_catalogue.py"
PAGE = REPOSITORY / "docs" / "catalogue.md"


@pytest.fixture(scope="module")
def script():
    return runpy.run_path(str(SCRIPT))


def test_committed_page_is_what_the_classes_say(script):
    """An effect that was added or changed is on the page."""
    stale = "docs/catalogue.md is not what the classes say: run `python experiments/write_catalogue.py`"
    assert PAGE.read_text(encoding="utf-8") == script["page"](), stale


@pytest.mark.parametrize("name", catalogue())
def test_page_has_every_effect_with_its_parameters(name):
    """Each effect has a section of its own that names its equation, source and every parameter."""
    sections = {part.partition("\n")[0]: part for part in PAGE.read_text(encoding="utf-8").split("\n## ")[1:]}
    effect = catalogue()[name]
    assert effect.equation in sections[name]
    assert effect.source in sections[name]
    for parameter in effect.parameters:
        assert f"| `{parameter.name}` |" in sections[name]


def test_tables_are_whole(script):
    """Bars in equations do not break a row: every row of a table has as many cells as its head."""
    lines = script["page"]().splitlines()
    width = None
    for line in lines:
        cells = line.replace("\\|", "").count("|") if line.startswith("|") else None
        if width is not None and cells is not None:
            assert cells == width, line
        width = cells


def test_the_script_writes_the_page(script, tmp_path, monkeypatch, capsys):
    """The command of the page's first line makes the page."""
    out = tmp_path / "catalogue.md"
    monkeypatch.setattr("sys.argv", ["write_catalogue.py", "--out", str(out)])
    script["main"]()
    assert out.read_text(encoding="utf-8") == script["page"]()
    assert capsys.readouterr().out.strip() == str(out)
