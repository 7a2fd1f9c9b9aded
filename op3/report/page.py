"""One HTML page: verdict first, then key numbers, figures, tables, and provenance."""

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import jinja2
import plotly
import plotly.graph_objects as go
from markupsafe import Markup, escape

from op3.common.plain_names import words
from op3.common.private import scrub
from op3.common.writing import write_text
from op3.report.style import DARK
from op3.report.tables import Cell, TableRows, ends, in_thousandths, number, span

LIBRARY = "plotly.min.js"
"""JavaScript library that draws the figures, stored beside the pages or in the folder of a multirun."""


MOST_KEY_NUMBERS = 5
"""Largest number of key numbers at the end of a command."""


class Page:
    """A page generated from prose; it loads nothing from the network.

    Prose consists of blocks separated by blank lines. The first block is ``# the title`` followed by lines with the
    lead, whose first sentence, the verdict, is set large. Other blocks are a paragraph, ``## a heading``, ``[[code]]``
    and lines after it, or lines of ``[[tile name | value | unit | note]]`` (the row of key numbers under the verdict),
    ``[[figure name | caption]]``, ``[[table name | caption | digits]]``, ``[[film path | caption]]`` and ``[[file path
    | what is in it]]``. Missing figures and tables without rows are omitted.

    All text is escaped. Text between backticks is set as code.

    Args:
        prose: text of the page.
        figures: figures by name; None for a figure without data.
        tables: header with units, and rows, by name; None is shown as a dash, and empty columns are omitted. Digits are
            the significant digits of non-integers, by default 4.
        template: template that generated the prose.
    """

    def __init__(
        self,
        prose: str,
        figures: Mapping[str, go.Figure | None] | None = None,
        tables: Mapping[str, TableRows] | None = None,
        template: str = "",
    ):
        self.template = template
        self._blocks: list[dict[str, Any]] = []
        self._tiles: list[dict[str, str]] = []
        self._figures: list[Markup] = []
        self._provenance: dict[str, str] = {}
        first, *blocks = map(str.strip, re.split(r"\n\s*\n", prose.strip()))
        title, _, lead = first.removeprefix("# ").partition("\n")
        self._title, lead = _one_line(title), _one_line(lead)
        end = re.search(r"(?<=[.!?])\s+(?=[^a-z])", lead)
        self._verdict, self._detail = (lead[: end.start()], lead[end.end() :]) if end else (lead, "")
        for block in blocks:
            if block.startswith("## "):
                self._add("section", block[3:])
            elif block.startswith("[[code]]\n"):
                self._add("code", scrub(block.removeprefix("[[code]]\n")))
            elif block.startswith("[["):
                for line in re.split(r"\n(?=\[\[)", block):
                    self._direct(line, figures or {}, tables or {})
            else:
                self._add("text", _one_line(block))

    @classmethod
    def of(
        cls,
        template: str,
        figures: Mapping[str, go.Figure | None] | None = None,
        tables: Mapping[str, TableRows] | None = None,
        **context: Any,
    ) -> Self:
        """The page with prose from the Jinja template ``<template>.md`` in ``templates/`` and the context."""
        context |= {"figures": figures or {}, "tables": tables or {}}
        prose = PROSE_TEMPLATES.get_template(f"{template}.md").render(context)
        return cls(prose, figures, tables, template)

    def _direct(self, line: str, figures: Mapping[str, go.Figure | None], tables: Mapping[str, TableRows]) -> None:
        """Insert the element that one line of prose in double brackets requests."""
        found = re.fullmatch(r"\[\[(tile|figure|table|film|file) (.*)\]\]", " ".join(line.split()))
        assert found, line
        kind, (name, *more) = found[1], [part.strip() for part in found[2].split("|")]
        if kind == "tile":
            value, unit, note = [*more, "", ""][:3]
            self._tiles.append({"name": name, "value": value, "unit": unit, "note": note})
        elif kind == "figure":
            if (figure := figures.get(name)) is not None:
                self._figure(figure, more[0] if more else "")
        elif kind == "table":
            header, rows = tables.get(name, ((), ()))
            if rows:
                caption, digits = (*more, *("", "4")[len(more) :])
                self._table(header, rows, caption, int(digits))
        else:
            if not self._blocks or self._blocks[-1]["kind"] != kind:
                self._add(kind, items=[])
            self._blocks[-1]["items"].append((name, *more))

    def _figure(self, figure: go.Figure, caption: str) -> None:
        # `<` inside the data must not end the script element
        self._figures.append(Markup(str(figure.to_json()).replace("<", "\\u003c")))
        margin, columns = figure.layout.margin, len({axis.domain for axis in figure.select_xaxes()})
        width = max(320, 280 * columns) + (margin.l or 0) + (margin.r or 0)  # narrower screens scroll it sideways
        self._add("figure", caption, height=int(figure.layout.height or 420), width=width)

    def _table(self, header: Sequence[str], rows: Sequence[Sequence[Cell]], caption: str, digits: int) -> None:
        """A sortable table without empty columns, with numbers aligned at the decimal point."""
        filled = [column for column in zip(header, *rows, strict=True) if set(column[1:]) - {None, ""}]
        columns = [_column(name, cells, digits) for name, *cells in filled]
        cells = zip(*(column["cells"] for column in columns), strict=True)
        self._add("table", caption, columns=columns, rows=list(cells))

    def provenance(self, values: Mapping[str, Any]) -> None:
        """Add the provenance at the foot of the page; nested mappings become one line each."""
        self._provenance |= {key.replace("_", " "): _line(scrub(value)) for key, value in values.items()}

    @property
    def headline(self) -> str:
        """The lead under the title, which states the result."""
        return f"{self._verdict} {self._detail}".strip()

    @property
    def key_numbers(self) -> list[str]:
        """At most five tiles as lines of text: name, value, unit, and reference for comparison."""
        lines = [
            f"{t['name']}: {t['value']} {t['unit']}".rstrip() + f" ({t['note']})" * bool(t["note"]) for t in self._tiles
        ]
        return lines[:MOST_KEY_NUMBERS]

    def html(self, library: str = LIBRARY) -> str:
        """The page as text; `library` is the path of `LIBRARY` from the page."""
        return _TEMPLATES.get_template("page.html").render(
            title=self._title, verdict=self._verdict, detail=self._detail, tiles=self._tiles, blocks=self._blocks,
            sections=[block for block in self._blocks if block["kind"] == "section"], figures=self._figures,
            provenance=self._provenance, library=library, dark=Markup(json.dumps(DARK)),
            style=_asset("page.css"), script=_asset("page.js"),
        )  # fmt: skip

    def write(self, path: str | Path) -> Path:
        """Write the page atomically."""
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


def _one_line(text: str) -> str:
    return scrub(" ".join(text.split()))


def _asset(name: str) -> Markup:
    assert _TEMPLATES.loader is not None
    return Markup(_TEMPLATES.loader.get_source(_TEMPLATES, name)[0])


def _inline(text: str) -> Markup:
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def _is_number(cell: object) -> bool:
    return isinstance(cell, int | float) and not isinstance(cell, bool)


def _text(cell: Cell, digits: int = 3) -> str:
    """The text of a cell."""
    if cell is None or isinstance(cell, bool):
        return {None: "–", True: "yes", False: "no"}[cell]
    return number(cell, digits) if isinstance(cell, int | float) else cell


def _column(name: str, cells: Sequence[Cell], digits: int) -> dict[str, Any]:
    """The cells of a column; numbers and gaps are padded to align their digits."""
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


_OPTIONS: dict[str, Any] = dict(
    loader=jinja2.PackageLoader("op3.report"), trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
)
# text is escaped when the page is written; included templates end with a blank line
PROSE_TEMPLATES = jinja2.Environment(keep_trailing_newline=True, **_OPTIONS)
PROSE_TEMPLATES.filters |= {
    "number": _text, "words": words, "span": span, "ends": ends, "unit": lambda unit: in_thousandths(None, unit)[1],
    "in_unit": lambda value, unit: _text(in_thousandths(value, unit)[0]),
}  # fmt: skip
_TEMPLATES = jinja2.Environment(autoescape=True, **_OPTIONS)
_TEMPLATES.filters["inline"] = _inline
