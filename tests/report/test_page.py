"""The page: valid, self-contained, verdict first, text escaped."""

import base64
import json
import re

import mujoco
import numpy as np
import plotly.graph_objects as go
import pytest
from report_logs import PageReader, squat_log

from op3.report import Page, traces_figure


def example() -> Page:
    page = Page("Identification of squat-0", "With DTE the loss is 0.031. Without it 0.092.")
    page.tile("position error", 11.42, "mrad", "19.8 without")
    page.section("Measured and simulated")
    page.text("One paragraph.\n\nAnother with `code`.")
    page.figure(traces_figure(squat_log(), {"with DTE": {}}), "Knees.")
    page.table(["parameter", "value [N m]"], [["friction", 0.25], ["stiction", None]], "Parameters")
    page.files({"result.yaml": "all numbers"})
    page.provenance({"seed": 0, "versions": {"torch": "2.13.0"}})
    return page


def test_tags_nest_and_all_close():
    """A page is well-formed HTML."""
    assert PageReader(example().html()).open == []


def test_the_verdict_is_the_first_sentence_after_the_title():
    """The lead's first sentence stands before everything but the title, the rest follows."""
    texts = [text for tag, text in PageReader(example().html()).texts if tag in ("h1", "p", "div")]
    assert texts[:3] == ["Identification of squat-0", "With DTE the loss is 0.031.", "Without it 0.092."]


@pytest.mark.parametrize(
    ("lead", "verdict"),
    [
        ("Loss 0.031 against 0.092", "Loss 0.031 against 0.092"),
        ("It fell, e.g. twice. Then it stood.", "It fell, e.g. twice."),
        ("Nothing is missing! 3 logs agree.", "Nothing is missing!"),
    ],
)
def test_a_sentence_ends_where_the_next_begins(lead, verdict):
    """Decimal points and abbreviations within a sentence do not end the verdict."""
    assert f'<p class="verdict">{verdict}</p>' in Page("t", lead).html()


def test_nothing_is_loaded_from_elsewhere(tmp_path):
    """No element refers to another host, styles import nothing, and the browser is told to refuse all of it."""
    html = example().write(tmp_path / "run" / "index.html").read_text()
    reader = PageReader(html)
    refers = [value for _, name, value in reader.attributes if name in ("src", "href", "srcset", "data", "action")]
    assert refers
    assert not [value for value in refers if re.match(r"\s*(\w+:)?//", value)]
    assert not [tag for tag, *_ in reader.attributes if tag in ("link", "iframe", "object", "embed")]
    style = re.search(r"<style>(.*?)</style>", html, re.DOTALL)
    assert style
    assert "url(" not in style[1]
    assert "@import" not in style[1]
    assert (
        "default-src 'none'" in dict((name, value) for _, name, value in reader.attributes if "src" in value)["content"]
    )


def test_plotly_is_inlined_once_and_only_for_figures():
    """Two figures share one copy of the library, and a page without figures stays small."""
    page = example()
    page.figure(go.Figure(go.Scatter(y=[1, 2])), "Another.")
    html = page.html()
    assert 4_000_000 < len(html) < 6_000_000
    bare = Page("t", "v")
    bare.text("No figure.")
    assert len(bare.html()) < 20_000


def test_embedded_figures_are_the_figures():
    """The data in the page read back as the figure that was given."""
    figure = go.Figure(go.Scatter(y=[1.0, 2.0], name="a</script><b>"))
    page = Page("t", "v")
    page.figure(figure, "c")
    scripts = PageReader(page.html()).scripts
    assert json.loads(scripts[0]) == json.loads(figure.to_json() or "")


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
    """Fractions of a column take the same room, so the points stand in one line."""
    page = Page("t", "v")
    page.table(["name", "value [N m]"], [["a", 0.12], ["b", 12.5], ["c", None], ["d", -3]])
    html = page.html()
    assert re.findall(r'<td class="number">(.*?)<span class="fraction" style="width:(\d)ch">(.*?)</span>', html) == [
        ("0", "3", ".12"),
        ("12", "3", ".5"),
        ("–", "3", ""),
        ("−3", "3", ""),
    ]


def test_a_ragged_table_is_refused():
    """A row of the wrong length is named."""
    with pytest.raises(ValueError, match="row 1 of the table has 1 cells, the header 2"):
        Page("t", "v").table(["a", "b"], [[1, 2], [3]])


def test_a_figure_without_data_adds_nothing():
    """None in place of a figure leaves the numbering alone."""
    page = Page("t", "v")
    page.figure(None, "Body.")
    page.figure(go.Figure(), "Joints.")
    assert "Figure 1." in page.html()
    assert "Body." not in page.html()


def test_provenance_stands_at_the_foot():
    """Nested facts are one line in the footer."""
    html = example().html()
    assert html.index("<footer>") > html.index("</main>")
    assert "<dt>versions</dt><dd>torch 2.13.0</dd>" in html


def test_a_picture_holds_its_pixels():
    """The inlined PNG decodes to the image, as MuJoCo's reader sees it."""
    image = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    page = Page("t", "v")
    page.picture(image, "A frame.")
    source = dict((name, value) for tag, name, value in PageReader(page.html()).attributes if tag == "img")["src"]
    data = base64.b64decode(source.removeprefix("data:image/png;base64,"))
    xml = '<mujoco><asset><texture name="t" type="2d" file="a.png"/></asset></mujoco>'
    decoded = mujoco.MjModel.from_xml_string(xml, {"a.png": data}).tex_data.reshape(5, 7, 3)
    np.testing.assert_array_equal(decoded, image)


def test_a_picture_of_the_wrong_type_is_refused():
    """Floats are not pixels."""
    with pytest.raises(ValueError, match=r"uint8 \[height, width, 3\], got float64 \[5, 7, 3\]"):
        Page("t", "v").picture(np.zeros((5, 7, 3)), "A frame.")
