"""The page: valid, loads nothing from elsewhere, verdict first, text escaped, readable in both colour schemes."""

import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import jinja2
import numpy as np
import plotly.graph_objects as go
import pytest
from PIL import Image
from report_logs import PageReader, squat_log

from op3.report import Page, traces_figure
from op3.report.page import LIBRARY, PROSE_TEMPLATES

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def example() -> Page:
    page = Page("Identification of squat-0", "With DTE the loss is 0.031. Without it 0.092.")
    page.tile("position error", 11.42, "mrad", "19.8 without")
    page.section("Measured and simulated")
    page.text("One paragraph.\n\nAnother with `code`.")
    page.figure(traces_figure(squat_log(), {"with DTE": {}}), "Knees.")
    page.table(["parameter", "value [N m]"], [["friction", 0.25], ["stiction", None], ["bias", 12.5]], "Parameters")
    page.films([("film.mp4", "An episode.")])
    page.files({"result.yaml": "all numbers"})
    page.provenance({"seed": 0, "versions": {"torch": "2.13.0"}})
    return page


def test_tags_nest_and_all_close():
    """A page is well-formed HTML."""
    assert PageReader(example().html()).open == []


@pytest.mark.parametrize(
    ("lead", "verdict", "detail"),
    [
        ("Loss 0.031 against 0.092", "Loss 0.031 against 0.092", ""),
        ("It fell, e.g. twice. Then it stood.", "It fell, e.g. twice.", "Then it stood."),
        ("Nothing is missing! 3 logs agree.", "Nothing is missing!", "3 logs agree."),
    ],
)
def test_the_verdict_is_the_first_sentence_after_the_title(lead, verdict, detail):
    """The rest follows; decimal points and abbreviations within a sentence do not end it."""
    texts = [text for tag, text in PageReader(Page("t", lead).html()).texts if tag in ("h1", "p")]
    assert texts == ["t", verdict, *([detail] if detail else [])]


def test_nothing_is_loaded_from_elsewhere(tmp_path):
    """No element refers to another host, styles import nothing, and the browser is told to refuse all of it."""
    html = example().write(tmp_path / "run" / "index.html").read_text()
    reader = PageReader(html)
    refers = [value for _, name, value in reader.attributes if name in ("src", "href", "srcset", "data", "action")]
    assert LIBRARY in refers
    assert not [value for value in refers if re.match(r"\s*(\w+:)?//", value)]
    assert not [tag for tag, *_ in reader.attributes if tag in ("link", "iframe", "object", "embed")]
    style = re.search(r"<style>(.*?)</style>", html, re.DOTALL)
    assert style
    assert not re.search(r"url\(|@import", style[1])
    assert "default-src 'none'" in html


def test_the_library_lies_once_beside_the_pages_of_a_folder(tmp_path):
    """Runs of a multirun share the one above them; a page without figures needs none, and pages stay small."""
    for cell in ("sweep/0", "sweep/1", "sweep"):
        path = example().write(tmp_path / cell / "index.html")
        assert path.stat().st_size < 200_000
    assert [path.parent.name for path in tmp_path.rglob(LIBRARY)] == ["sweep"]
    assert f'src="../{LIBRARY}"' in (tmp_path / "sweep" / "0" / "index.html").read_text()
    Page("t", "v").write(tmp_path / "bare" / "index.html")
    assert [path.name for path in (tmp_path / "bare").iterdir()] == ["index.html"]


def test_embedded_figures_are_the_figures():
    """The data in the page read back as the figure that was given."""
    figure = go.Figure(go.Scatter(y=[1.0, 2.0], name="a</script><b>"))
    page = Page("t", "v")
    page.figure(None, "Nothing to draw here.")
    page.figure(figure, "c")
    reader = PageReader(page.html())
    assert json.loads(reader.scripts[0]) == json.loads(figure.to_json() or "")
    assert "Figure 1." in reader.text
    assert "Nothing to draw" not in reader.text


@pytest.mark.parametrize(
    "where", ["title", "lead", "tile", "section", "text", "code", "caption", "cell", "file", "source"]
)
def test_user_text_is_escaped(where):
    """Text that looks like HTML appears as text, wherever it enters."""
    evil = '<img src="x" onerror="alert(1)"> & co'
    page = Page(evil if where == "title" else "t", evil if where == "lead" else "v")
    page.tile(evil if where == "tile" else "n", 1.0)
    page.section(evil if where == "section" else "s")
    page.text(evil if where == "text" else "x")
    page.code(evil if where == "code" else "x")
    page.figure(go.Figure(), evil if where == "caption" else "c")
    page.table(["h"], [[evil if where == "cell" else "c"]])
    page.files({evil if where == "file" else "f": "x"})
    page.provenance({"data": evil if where == "source" else "d"})
    reader = PageReader(page.html())
    assert evil in reader.text
    assert not [tag for tag, *_ in reader.attributes if tag == "img"]


def test_numbers_in_a_column_share_the_decimal_point():
    """Shorter fractions end with room for the digits (U+2007) and the point (U+2008) that others have more."""
    page = Page("t", "v")
    page.table(["name", "value [N m]"], [["a", 0.12], ["b", 12.5], ["c", None], ["d", -3]])
    cells = [text for tag, text in PageReader(page.html()).texts if tag == "td"]
    assert cells[1::2] == ["0.12", "12.5\u2007", "–\u2008\u2007\u2007", "−3\u2008\u2007\u2007"]


PROSE = """
## Part {{ n }}

One
paragraph.

[[figure no | Gone.]]

[[table none | Gone.]]

[[table some | Kept.]]

[[code]]
op3 view
"""


def test_a_template_of_prose_leaves_out_what_is_not_there(monkeypatch):
    """Headings, paragraphs, tables and commands come in their order; an absent figure and an empty table go."""
    monkeypatch.setattr(PROSE_TEMPLATES, "loader", jinja2.DictLoader({"part.md": PROSE}))
    page = Page("t", "v")
    page.fill("part", {"no": None}, {"none": (["a"], []), "some": (["a"], [[1]])}, n=1)
    reader = PageReader(page.html())
    told = [text for tag, text in reader.texts if tag in ("h2", "p", "td", "pre")]
    assert told == ["v", "Part 1", "One paragraph.", "1", "op3 view"]
    assert "Gone" not in reader.text


def test_a_ragged_table_is_refused():
    """A row of the wrong length is named."""
    with pytest.raises(ValueError, match="row 1 of the table has 1 cells, the header 2"):
        Page("t", "v").table(["a", "b"], [[1, 2], [3]])


def test_provenance_stands_at_the_foot():
    """Nested facts are one line in the footer."""
    html = example().html()
    assert html.index("<footer>") > html.index("</main>")
    assert "<dt>versions</dt><dd>torch 2.13.0</dd>" in html


SORT = """<script>for (let i = 0; i < CLICKS; i++) document.querySelectorAll("th")[1].click();</script></body>"""
WIDTH = """<script>document.title = "wide " + document.documentElement.scrollWidth;</script></body>"""


def browse(path: Path, *options: str, dark: bool = False) -> str:
    """What a browser makes of a page."""
    scheme = ["--blink-settings=preferredColorScheme=0"] if dark else []
    command = [
        str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=5000",
        f"--user-data-dir={path.parent}/profile", *scheme, *options, path.as_uri(),
    ]  # fmt: skip
    environment = {**os.environ, "HOME": str(path.parent)}
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=True, env=environment).stdout


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
@pytest.mark.parametrize(
    ("dark", "clicks", "order"),
    [(False, 1, ["friction", "bias", "stiction"]), (True, 2, ["bias", "friction", "stiction"])],
)
def test_a_browser_draws_figures_in_both_schemes_and_sorts_tables(tmp_path, dark, clicks, order):
    """Figures take the colours of the scheme, the note that they are missing goes; a gap is last, whichever way."""
    path = example().write(tmp_path / "index.html")
    path.write_text(path.read_text().replace("</body>", SORT.replace("CLICKS", str(clicks))))
    dom = browse(path, "--dump-dom", dark=dark)
    assert "main-svg" in dom
    assert "The figures need JavaScript" not in dom
    colours = {"light": "rgb(22, 24, 29)", "dark": "rgb(233, 235, 238)"}
    assert (colours["dark"] in dom, colours["light"] in dom) == (dark, not dark)
    body = dom[dom.index("<tbody>") : dom.index("</tbody>")]
    assert re.findall(r"<td>(\w+)</td>", body) == order


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_the_whole_page_in_the_colours_of_its_scheme(tmp_path, dark):
    """Nothing is wider than the narrowest window of a browser without a screen, 500 pixels; the ground is the scheme's,
    and what stands on it is seen."""
    path = example().write(tmp_path / "index.html")
    path.write_text(path.read_text().replace("</body>", WIDTH))
    picture = tmp_path / "phone.png"
    assert "<title>wide 500</title>" in browse(path, "--dump-dom", "--window-size=500,1200", dark=dark)
    browse(path, f"--screenshot={picture}", "--window-size=500,1200", dark=dark)
    shades = np.asarray(Image.open(picture).convert("L"), dtype=float)
    ground = np.median(shades)
    assert ground < 40 if dark else ground > 240
    assert (np.abs(shades - ground) > 150).mean() > 0.005
