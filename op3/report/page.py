"""One HTML page: verdict first, then key numbers, figures, tables, and where it all comes from."""

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import plotly
import plotly.graph_objects as go
from markupsafe import Markup, escape

from op3.private import scrub
from op3.report.style import DARK, words
from op3.report.tables import Cell, number
from op3.rollout.files import write_text

LIBRARY = "plotly.min.js"
"""Draws the figures; it lies beside the pages of a folder, or above those of a multirun's numbered folders."""


class Page:
    """A page that is built from top to bottom and written once; it loads nothing from elsewhere and works offline.

    All text is escaped. Text between backticks is set as code.

    Args:
        title: what was done, to what.
        lead: the outcome. Its first sentence, the verdict, is set large.
    """

    def __init__(self, title: str, lead: str):
        lead = " ".join(lead.split())
        end = re.search(r"(?<=[.!?])\s+(?=[^a-z])", lead)
        self._title, self._verdict = title, lead[: end.start()] if end else lead
        self._detail = lead[end.end() :] if end else ""
        self._tiles: list[dict[str, Any]] = []
        self._blocks: list[dict[str, Any]] = []
        self._figures: list[Markup] = []
        self._provenance: dict[str, str] = {}

    def tile(self, name: str, value: Cell, unit: str = "", note: str = "") -> None:
        """Add a key number to the row under the verdict.

        Args:
            name: what it is, in two or three words.
            value: a number is rounded to three digits.
            unit: of the number.
            note: what to compare it with.
        """
        self._tiles.append({"name": name, "value": value, "unit": unit, "note": note})

    def section(self, heading: str) -> None:
        """Start a section."""
        self._add("section", heading)

    def text(self, text: str) -> None:
        """Add paragraphs, separated by blank lines."""
        for paragraph in filter(None, re.split(r"\n\s*\n", text.strip())):
            self._add("text", scrub(paragraph))

    def code(self, text: str) -> None:
        """Add lines as they are, such as a command or the head of a file."""
        self._add("code", scrub(text))

    def figure(self, figure: go.Figure | None, caption: str) -> None:
        """Add a figure with its caption; None, for a figure that a log has no data for, adds nothing."""
        if figure is None:
            return
        # `<` inside the data must not end the script element
        self._figures.append(Markup(str(figure.to_json()).replace("<", "\\u003c")))
        margin, columns = figure.layout.margin, len({axis.domain for axis in figure.select_xaxes()})
        width = max(320, 240 * columns) + (margin.l or 0) + (margin.r or 0)  # narrower screens move it sideways
        self._add("figure", caption, height=int(figure.layout.height or 420), width=width)

    def fill(
        self,
        template: str,
        figures: Mapping[str, go.Figure | None] | None = None,
        tables: Mapping[str, tuple] | None = None,
        **context: Any,
    ) -> None:
        """Add what a template of prose says: blocks with blank lines between them.

        A block is a paragraph, ``## a heading``, ``[[figure name | caption]]``, ``[[table name | caption]]``, or
        ``[[code]]`` and lines after it. Figures and tables that are not there, or have no rows, are left out.

        Args:
            template: name of the file ``<name>.md`` in ``templates/``, Jinja's.
            figures: by name.
            tables: header, rows and perhaps digits by name, as `table` takes them.
            context: what the template speaks of.
        """
        for block in re.split(r"\n\s*\n", PROSE_TEMPLATES.get_template(f"{template}.md").render(context).strip()):
            found = re.fullmatch(r"\[\[(figure|table) (\w+)(?: \| (.*))?\]\]", block.strip(), re.DOTALL)
            if block.startswith("## "):
                self.section(block[3:])
            elif block.startswith("[[code]]\n"):
                self.code(block.removeprefix("[[code]]\n"))
            elif found is None:
                self.text(" ".join(block.split()))
            elif found[1] == "figure":
                self.figure((figures or {}).get(found[2]), " ".join((found[3] or "").split()))
            elif (given := (tables or {}).get(found[2])) and given[1]:
                header, rows, *digits = given
                self.table(header, rows, " ".join((found[3] or "").split()), *digits)

    def films(self, films: Sequence[tuple[str, str]]) -> None:
        """Add films, as paths from the page with a caption each, side by side where there is room."""
        if films:
            self._add("films", films=films)

    def table(self, header: Sequence[str], rows: Sequence[Sequence[Cell]], caption: str = "", digits: int = 4) -> None:
        """Add a table, which the reader can sort; numbers are aligned at the decimal point.

        Args:
            header: of the columns, with units.
            rows: cells; None shows as a dash.
            caption: set above the table.
            digits: significant digits of numbers that are not integers.

        Raises:
            ValueError: if a row is not as long as the header.
        """
        for i, row in enumerate(rows):
            if len(row) != len(header):
                raise ValueError(f"row {i} of the table has {len(row)} cells, the header {len(header)}")
        columns = [_column(name, [row[i] for row in rows], digits) for i, name in enumerate(header)]
        cells = zip(*(column["cells"] for column in columns), strict=True)
        self._add("table", caption, columns=columns, rows=list(cells))

    def files(self, files: Mapping[str, str]) -> None:
        """Link files that lie beside the page: relative path, and what is in them."""
        self._add("files", files=files)

    def side_files(self, files: Mapping[str, str] | None) -> None:
        """Add a section of files beside the page, where there are any; films among them are shown."""
        if files:
            self.section("Files")
            self.films([(name, text) for name, text in files.items() if name.endswith(".mp4")])
            self.files(files)

    def provenance(self, values: Mapping[str, Any]) -> None:
        """Say at the foot where the page comes from; nested mappings become one line each."""
        self._provenance |= {key.replace("_", " "): _line(scrub(value)) for key, value in values.items()}

    def html(self, library: str = LIBRARY) -> str:
        """The page as text.

        Args:
            library: path of `LIBRARY` from the page.
        """
        return _TEMPLATES.get_template("page.html").render(
            title=self._title, verdict=self._verdict, detail=self._detail, tiles=self._tiles, blocks=self._blocks,
            sections=[block for block in self._blocks if block["kind"] == "section"], figures=self._figures,
            provenance=self._provenance, library=library, dark=Markup(json.dumps(DARK)),
            style=_asset("page.css"), script=_asset("page.js"),
        )  # fmt: skip

    def write(self, path: str | Path) -> Path:
        """Write the page; the file appears whole or not at all."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        numbered = path.resolve().parent.name.isdecimal()
        library = path.parent / ".." / LIBRARY if numbered else path.parent / LIBRARY
        if self._figures and not library.exists():
            shutil.copyfile(Path(plotly.__path__[0]) / "package_data" / LIBRARY, library)
        write_text(path, self.html(f"../{LIBRARY}" if numbered else LIBRARY))
        return path

    def _add(self, kind: str, text: str = "", **more: Any) -> None:
        count = 1 + sum(block["kind"] == kind for block in self._blocks)
        self._blocks.append({"kind": kind, "text": text, "count": count, **more})


def _asset(name: str) -> Markup:
    assert _TEMPLATES.loader is not None
    return Markup(_TEMPLATES.loader.get_source(_TEMPLATES, name)[0])


def _inline(text: str) -> Markup:
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _is_number(cell: object) -> bool:
    return isinstance(cell, int | float) and not isinstance(cell, bool)


def _text(cell: Cell, digits: int = 4) -> str:
    """A cell as it is read."""
    if cell is None or isinstance(cell, bool):
        return {None: "–", True: "yes", False: "no"}[cell]
    return number(cell, digits) if isinstance(cell, int | float) else cell


def _column(name: str, cells: Sequence[Cell], digits: int) -> dict[str, Any]:
    """A column; numbers, and gaps among them, end with room for the digits that others have more."""
    numeric = any(map(_is_number, cells)) and all(cell is None or _is_number(cell) for cell in cells)
    texts = [_text(cell, digits) for cell in cells]
    if numeric:
        fractions = [text.partition(".")[1] + text.partition(".")[2] for text in texts]
        widest = max(map(len, fractions))
        # U+2008 is as wide as a point, U+2007 as a digit
        rooms = [
            (widest - len(f)) * "\u2007" if f or not widest else "\u2008" + (widest - 1) * "\u2007" for f in fractions
        ]
        texts = [text + room for text, room in zip(texts, rooms, strict=True)]
    values = ["" if cell is None else cell for cell in cells]
    shown = [{"text": text, "value": value} for text, value in zip(texts, values, strict=True)]
    return {"name": name, "numeric": numeric, "cells": shown}


def _line(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key.replace('_', ' ')} {_line(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_line, value))
    return _text(value) if value is None or isinstance(value, bool) else str(value)


PROSE_TEMPLATES = jinja2.Environment(  # its text is escaped when the page is written
    loader=jinja2.PackageLoader("op3.report"), trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
)
PROSE_TEMPLATES.filters |= {"number": lambda value, digits=3: _text(value, digits), "words": words}
_TEMPLATES = jinja2.Environment(
    loader=jinja2.PackageLoader("op3.report"), autoescape=True, trim_blocks=True, lstrip_blocks=True,
    undefined=jinja2.StrictUndefined,
)  # fmt: skip
_TEMPLATES.filters |= {"inline": _inline, "cell": _text}
