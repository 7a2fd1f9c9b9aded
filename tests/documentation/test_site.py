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


def test_every_link_leads_somewhere_in_a_bare_checkout():
    """Pages are read where they lie as well as on the site; the catalogue is what the classes tell."""
    assert (ROOT / "docs" / "catalogue.md").read_text(encoding="utf-8") == PAGES["page"](), "run python docs/site.py"
    for page in DOCUMENTS:
        links = re.findall(r"\]\(([^)#\s:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
        assert not (dead := [link for link in links if not (page.parent / link).exists()]), f"{page.name}: {dead}"


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
