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

from op3.report.page import LIBRARY, PROSE_TEMPLATES, Page
from op3.report.trace_figures import traces_figure

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


PROSE = """
# Identification of {{ log }}
With DTE the loss is {{ 0.03112 | number }}.
Without it 0.092.

[[tile position error | {{ 11.42 | number }} | mrad | 19.8 without]]
[[tile trials | 4]]

## Measured and simulated

One
paragraph with `code`.

[[figure no | Gone.]]

[[figure knees | Knees.]]

[[table none | Gone.]]

[[table parameters | Parameters | 2]]

[[film film.mp4 | An episode.]]

[[file result.yaml | all numbers]]
[[file model.yaml | the model]]

[[code]]
op3 view
"""
TABLE = (["parameter", "value [N m]"], [["friction", 0.251], ["stiction", None], ["bias", 12.5]])


@pytest.fixture
def example(monkeypatch) -> Page:
    monkeypatch.setattr(PROSE_TEMPLATES, "loader", jinja2.DictLoader({"part.md": PROSE}))
    figures, tables = {"no": None, "knees": traces_figure(squat_log(), {})}, {"parameters": TABLE}
    page = Page.of("part", figures, {"none": (["a"], []), **tables}, log="squat-0")
    page.provenance({"seed": 0, "versions": {"torch": "2.13.0"}})
    return page


def test_a_template_tells_the_page(example):
    """Verdict, tiles, paragraphs, tables, lists and commands come in their order; what is not there is left out."""
    reader = PageReader(example.html())
    assert reader.open == []
    told = [text for tag, text in reader.texts if tag in ("h1", "h2", "p", "b", "td", "pre", "a")]
    assert told[:3] == ["Identification of squat-0", "With DTE the loss is 0.0311.", "Without it 0.092."]
    assert "One paragraph with " in told
    assert [text for tag, text in reader.texts if tag == "td"][::2] == ["friction", "stiction", "bias"]
    assert "op3 view" in told
    assert ("all numbers" in reader.text, "Gone" in reader.text) == (True, False)


def test_title_and_lead_do_not_tell_where_the_files_are(tmp_path):
    """Folders of the machine are left out, as they are in the text below."""
    page = Page(f"# Training on {tmp_path}/runs/identify/model.yaml, seed 0\nMade from {tmp_path}/a/b.csv.").html()
    assert ".../identify/model.yaml, seed 0" in page
    assert str(tmp_path) not in page


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
    texts = [text for tag, text in PageReader(Page(f"# t\n{lead}").html()).texts if tag in ("h1", "p")]
    assert texts == ["t", verdict, *([detail] if detail else [])]


def test_nothing_is_loaded_from_elsewhere(tmp_path, example):
    """No element refers to another host, styles import nothing, and the browser is told to refuse all of it."""
    html = example.write(tmp_path / "run" / "index.html").read_text()
    reader = PageReader(html)
    refers = [value for _, name, value in reader.attributes if name in ("src", "href", "srcset", "data", "action")]
    assert LIBRARY in refers
    assert not [value for value in refers if re.match(r"\s*(\w+:)?//", value)]
    assert not [tag for tag, *_ in reader.attributes if tag in ("link", "iframe", "object", "embed")]
    style = re.search(r"<style>(.*?)</style>", html, re.DOTALL)
    assert style
    assert not re.search(r"url\(|@import", style[1])
    assert "default-src 'none'" in html


def test_the_library_lies_once_beside_the_pages_of_a_folder(tmp_path, example):
    """Runs of a multirun share the one above them; a page without figures needs none, and pages stay small."""
    for cell in ("sweep/0", "sweep/1", "sweep"):
        path = example.write(tmp_path / cell / "index.html")
        assert path.stat().st_size < 200_000
    assert [path.parent.name for path in tmp_path.rglob(LIBRARY)] == ["sweep"]
    assert f'src="../{LIBRARY}"' in (tmp_path / "sweep" / "0" / "index.html").read_text()
    Page("# t\nv").write(tmp_path / "bare" / "index.html")
    assert [path.name for path in (tmp_path / "bare").iterdir()] == ["index.html"]


def test_embedded_figures_are_the_figures():
    """The data in the page read back as the figure that was given."""
    figure = go.Figure(go.Scatter(y=[1.0, 2.0], name="a</script><b>"))
    page = Page(
        "# t\nv\n\n[[figure none | Nothing to draw here.]]\n\n[[figure one | c]]", {"none": None, "one": figure}
    )
    reader = PageReader(page.html())
    assert json.loads(reader.scripts[0]) == json.loads(figure.to_json() or "")
    assert "Figure 1." in reader.text
    assert "Nothing to draw" not in reader.text


WHERE = ["title", "lead", "tile", "section", "paragraph", "code", "caption", "cell", "file", "source"]
EVERYWHERE = """
# {{ title }}
{{ lead }}

[[tile {{ tile }} | 1]]

## {{ section }}

{{ paragraph }}

[[code]]
{{ code }}

[[table t | {{ caption }}]]

[[file {{ file }} | x]]
"""


@pytest.mark.parametrize("where", WHERE)
def test_user_text_is_escaped(where, monkeypatch):
    """Text that looks like HTML appears as text, wherever it enters."""
    monkeypatch.setattr(PROSE_TEMPLATES, "loader", jinja2.DictLoader({"part.md": EVERYWHERE}))
    evil = '<img src="x" onerror="alert(1)"> & co'
    given = {name: evil if name == where else "x" for name in WHERE}
    page = Page.of("part", None, {"t": (["h"], [[given["cell"]]])}, **given)
    page.provenance({"data": given["source"]})
    reader = PageReader(page.html())
    assert evil in reader.text
    assert not [tag for tag, *_ in reader.attributes if tag == "img"]


def test_numbers_in_a_column_share_the_decimal_point():
    """Shorter fractions end with room for the digits (U+2007) and the point (U+2008) that others have more."""
    rows = [["a", 0.12], ["b", 12.5], ["c", None], ["d", -3]]
    page = Page("# t\nv\n\n[[table all]]", tables={"all": (["name", "value [N m]"], rows)})
    cells = [text for tag, text in PageReader(page.html()).texts if tag == "td"]
    assert cells[1::2] == ["0.12", "12.5\u2007", "–\u2008\u2007\u2007", "−3\u2008\u2007\u2007"]


def test_provenance_stands_at_the_foot(example):
    """Nested facts are one line in the footer."""
    html = example.html()
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
def test_a_browser_draws_figures_in_both_schemes_and_sorts_tables(tmp_path, example, dark, clicks, order):
    """Figures take the colours of the scheme, the note that they are missing goes; a gap is last, whichever way."""
    path = example.write(tmp_path / "index.html")
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
def test_a_phone_shows_the_whole_page_in_the_colours_of_its_scheme(tmp_path, example, dark):
    """Nothing is wider than the narrowest window of a browser without a screen, 500 pixels; the ground is the scheme's,
    and what stands on it is seen."""
    path = example.write(tmp_path / "index.html")
    path.write_text(path.read_text().replace("</body>", WIDTH))
    picture = tmp_path / "phone.png"
    assert "<title>wide 500</title>" in browse(path, "--dump-dom", "--window-size=500,1200", dark=dark)
    browse(path, f"--screenshot={picture}", "--window-size=500,1200", dark=dark)
    shades = np.asarray(Image.open(picture).convert("L"), dtype=float)
    ground = np.median(shades)
    assert ground < 40 if dark else ground > 240
    assert (np.abs(shades - ground) > 150).mean() > 0.005
