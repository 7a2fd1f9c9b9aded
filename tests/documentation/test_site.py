"""The site builds from the pages, the README and the classes, and its gallery shows what its commands make."""

import os
import re
import runpy
import subprocess
import sys

import pytest
from documented import PAGES as DOCUMENTS
from documented import ROOT

from op3.servo import catalogue

GALLERY = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
PAGES = runpy.run_path(str(ROOT / "docs" / "site.py"))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def test_no_link_is_broken_and_formulae_are_drawn(site):
    """Strict: a warning ends the build; the law's equations are MathML, which needs nothing from elsewhere."""
    page = (site / "servo_model.html").read_text(encoding="utf-8")
    assert "<math" in page
    assert "arithmatex" not in page
    assert "https://fonts" not in page


def test_every_effect_has_a_section(site):
    """The catalogue is that of the classes: equation, source and every parameter."""
    sections = {part.partition("\n")[0]: part for part in PAGES["page"]().split("\n## ")[1:]}
    assert set(sections) == set(catalogue())
    for name, effect in catalogue().items():
        assert effect.equation in sections[name]
        assert effect.source in sections[name]
        assert all(f"| `{parameter.name}` |" in sections[name] for parameter in effect.parameters)
        assert f'id="{name}"' in (site / "catalogue.html").read_text(encoding="utf-8")


def test_the_page_of_logs_has_the_tables_of_the_code(site):
    """Channels, formats and checks are those that the code has."""
    page = (site / "logs.html").read_text(encoding="utf-8")
    assert "table: " not in page
    for entry in ("command/position", "LeRobot dataset", "lost turns"):
        assert entry in page


def test_every_link_leads_somewhere_in_a_bare_checkout():
    """Pages are read where they lie as well as on the site; the site alone has the generated ones."""
    for page in [*DOCUMENTS, ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*/*.md")]:
        links = re.findall(r"\]\(([^)#\s:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
        dead = [link for link in links if not (page.parent / link).exists() and link != "catalogue.md"]
        assert not dead, f"{page.name}: {dead}"


def test_the_words_of_the_documentation_are_few():
    """Of README, of the results and of all pages that are written by hand; code and history do not count."""

    def words(page):
        text = page.read_text(encoding="utf-8")
        return len(re.sub(r"^( *)```.*?^\1```", "", text, flags=re.MULTILINE | re.DOTALL).split())

    assert words(ROOT / "README.md") <= 900
    assert words(ROOT / "docs" / "results.md") <= 2000
    written = [*(ROOT / "docs").glob("*.md"), ROOT / "docs" / "decisions" / "index.md"]
    assert sum(map(words, written)) <= 18_000


def test_the_reference_shows_every_command(site):
    """Functions and results come from the docstrings, with their arguments."""
    page = (site / "reference.html").read_text(encoding="utf-8")
    for name in ("collect", "identify", "predict", "diagnose", "train", "evaluate", "deploy", "sim2real"):
        assert f'id="op3.apps.{name}.{name}"' in page
    assert "90 % intervals" in page


def test_every_picture_stands_beside_the_command_that_made_it():
    """Ten or more, ours, each small enough for a repository."""
    shown = re.findall(
        r"!\[[^\]]+\]\((images/(\w+)\.webp)\)\n.*?```sh\npython experiments/gallery.py (\w+)\n", GALLERY, re.DOTALL
    )
    assert len(shown) == GALLERY.count("![") >= 10
    assert all(name == asked for _, name, asked in shown)
    assert {p.name for p in (ROOT / "docs" / "images").iterdir() if p.stat().st_size > 100_000} == set()


def test_a_picture_is_drawn_by_its_command(tmp_path):
    """The one that takes a second."""
    command = [sys.executable, "experiments/gallery.py", "gear", "--out", str(tmp_path)]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "gear.webp").stat().st_size > 5_000


def test_bars_in_equations_do_not_break_a_row():
    """Every row of a table has as many cells as its head."""
    width = None
    for line in PAGES["page"]().splitlines():
        cells = line.replace("\\|", "").count("|") if line.startswith("|") else None
        assert None in (width, cells) or cells == width, line
        width = cells
