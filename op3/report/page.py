"""One self-contained HTML page: verdict first, then key numbers, figures, tables, and where it all comes from."""

import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from op3.report.picture import film_element, png_element
from op3.report.tables import Cell, number
from op3.rollout.files import write_text

# The browser itself then refuses to load anything from elsewhere.
_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data: blob:; font-src data:"
)


class Page:
    """A page that is built from top to bottom and written once; it loads nothing and works offline.

    All text is escaped. Text between backticks is set as code.

    Args:
        title: what was done, to what.
        lead: the outcome. Its first sentence, the verdict, is set large.
    """

    def __init__(self, title: str, lead: str):
        self._title = title
        self._verdict, self._detail = _split(lead)
        self._tiles: list[str] = []
        self._sections: list[str] = []
        self._body: list[str] = []
        self._figures: list[str] = []
        self._tables = 0
        self._provenance: dict[str, str] = {}

    def tile(self, name: str, value: float | str | None, unit: str = "", note: str = "") -> None:
        """Add a key number to the row under the verdict.

        Args:
            name: what it is, in two or three words.
            value: a number is rounded to three digits.
            unit: of the number.
            note: what to compare it with.
        """
        shown = _cell(value, 3)
        unit = f' <span class="unit">{escape(unit)}</span>' if unit else ""
        note = f'<div class="note">{_inline(note)}</div>' if note else ""
        self._tiles.append(f'<div class="tile"><div class="name">{_inline(name)}</div><b>{shown}{unit}</b>{note}</div>')

    def section(self, heading: str) -> None:
        """Start a section."""
        self._sections.append(heading)
        self._body.append(f'<h2 id="section-{len(self._sections)}">{_inline(heading)}</h2>')

    def text(self, text: str) -> None:
        """Add paragraphs, separated by blank lines."""
        paragraphs = re.split(r"\n\s*\n", text.strip())
        self._body.extend(f"<p>{_inline(paragraph)}</p>" for paragraph in paragraphs)

    def code(self, text: str) -> None:
        """Add lines as they are, such as a command or the head of a file."""
        self._body.append(f"<pre>{escape(text)}</pre>")

    def figure(self, figure: go.Figure | None, caption: str) -> None:
        """Add a figure with its caption; None, for a figure that a log has no data for, adds nothing."""
        if figure is None:
            return
        # `<` inside the data must not end the script element
        self._figures.append(str(figure.to_json()).replace("<", "\\u003c"))
        count = len(self._figures)
        height = int(figure.layout.height or 420)
        self._body.append(
            f'<figure><div class="card"><div class="plot" id="figure-{count}" style="height:{height}px"></div></div>'
            f"<figcaption><b>Figure {count}.</b> {_inline(caption)}</figcaption></figure>"
        )

    def picture(self, image: np.ndarray, caption: str) -> None:
        """Add an image, uint8 ``[height, width, 3]``, for example a rendered frame."""
        self._body.append(f"<figure>{png_element(image, caption)}<figcaption>{_inline(caption)}</figcaption></figure>")

    def films(self, films: Sequence[tuple[bytes, str]]) -> None:
        """Add animated PNGs with a caption each, side by side where there is room."""
        shown = "".join(
            f"<figure>{film_element(data, caption)}<figcaption>{_inline(caption)}</figcaption></figure>"
            for data, caption in films
        )
        if shown:
            self._body.append(f'<div class="films">{shown}</div>')

    def table(self, header: Sequence[str], rows: Sequence[Sequence[Cell]], caption: str = "", digits: int = 4) -> None:
        """Add a table; numbers are aligned at the decimal point.

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
        self._tables += 1
        columns = list(zip(*rows, strict=True)) or [()] * len(header)
        numeric = [_numeric(column) for column in columns]
        fractions = [max((len(_fraction(cell, digits)) for cell in column), default=0) for column in columns]
        head = "".join(
            f'<th scope="col"{_right(n)}>{_inline(name)}</th>' for name, n in zip(header, numeric, strict=True)
        )
        body = "".join(
            "<tr>"
            + "".join(
                f"<td{_right(n)}>{_cell(cell, digits, width if n else None)}</td>"
                for cell, n, width in zip(row, numeric, fractions, strict=True)
            )
            + "</tr>"
            for row in rows
        )
        named = f"<caption><b>Table {self._tables}.</b> {_inline(caption)}</caption>" if caption else ""
        self._body.append(
            f'<div class="wide"><table>{named}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )

    def files(self, files: Mapping[str, str]) -> None:
        """Link files that lie beside the page: relative path, and what is in them."""
        items = "".join(
            f'<li><a href="{escape(name)}"><code>{escape(name)}</code></a> {_inline(text)}</li>'
            for name, text in files.items()
        )
        self._body.append(f'<ul class="files">{items}</ul>')

    def provenance(self, values: Mapping[str, Any]) -> None:
        """Say at the foot where the page comes from; nested mappings become one line each."""
        for key, value in values.items():
            self._provenance[key] = _line(value)

    def html(self) -> str:
        """The page as text."""
        return "".join(
            (
                '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
                f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
                '<meta name="viewport" content="width=device-width, initial-scale=1">',
                '<meta name="color-scheme" content="light dark">',
                f"<title>{escape(self._title)}</title><style>{_asset('page.css')}</style></head>\n<body>",
                self._header(),
                f"<main>{chr(10).join(self._body)}</main>\n",
                self._footer(),
                self._scripts(),
                "</body></html>\n",
            )
        )

    def write(self, path: str | Path) -> Path:
        """Write the page; the file appears whole or not at all."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, self.html())
        return path

    def _header(self) -> str:
        detail = f'<p class="detail">{_inline(self._detail)}</p>' if self._detail else ""
        tiles = f'<div class="tiles">{"".join(self._tiles)}</div>' if self._tiles else ""
        links = "".join(
            f'<a href="#section-{i}">{_inline(heading)}</a>' for i, heading in enumerate(self._sections, start=1)
        )
        contents = f'<nav aria-label="Contents">{links}</nav>' if len(self._sections) > 2 else ""
        return (
            f'<header><h1>{_inline(self._title)}</h1><p class="verdict">{_inline(self._verdict)}</p>'
            f"{detail}{tiles}{contents}</header>\n"
        )

    def _footer(self) -> str:
        if not self._provenance:
            return ""
        items = "".join(
            f"<dt>{escape(key.replace('_', ' '))}</dt><dd>{escape(value)}</dd>"
            for key, value in self._provenance.items()
        )
        return f"<footer><h2>Where this comes from</h2><dl>{items}</dl></footer>\n"

    def _scripts(self) -> str:
        if not self._figures:
            return ""
        data = "".join(
            f'<script type="application/json" id="figure-{i}-data">{json}</script>\n'
            for i, json in enumerate(self._figures, start=1)
        )
        library = get_plotlyjs()
        return (
            "<noscript><p>The figures need JavaScript; it is part of this file and loads nothing.</p></noscript>\n"
            f"{data}<script>{library}</script>\n<script>{_asset('page.js')}</script>\n"
        )


def _asset(name: str) -> str:
    return resources.files("op3.report").joinpath(name).read_text(encoding="utf-8")


def _split(lead: str) -> tuple[str, str]:
    """The first sentence and the rest."""
    lead = " ".join(lead.split())
    end = re.search(r"(?<=[.!?])\s+(?=[^a-z])", lead)
    return (lead, "") if end is None else (lead[: end.start()], lead[end.end() :])


def _inline(text: str) -> str:
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def _is_number(cell: object) -> bool:
    return isinstance(cell, int | float) and not isinstance(cell, bool)


def _numeric(column: Sequence[Cell]) -> bool:
    """Whether a column has numbers, and nothing else but gaps."""
    return any(map(_is_number, column)) and all(cell is None or _is_number(cell) for cell in column)


def _right(numeric: bool) -> str:
    return ' class="number"' if numeric else ""


def _fraction(cell: Cell, digits: int) -> str:
    """What stands from the decimal point on."""
    text = number(cell, digits) if _is_number(cell) else ""  # type: ignore[arg-type]
    whole = re.match(r"−?\d*", text)
    return text[whole.end() :] if whole else ""


def _cell(cell: Cell, digits: int, width: int | None = None) -> str:
    """A cell as HTML; with a width, the fraction takes that many digits' room so that points stand in line."""
    if cell is None:
        text, fraction = "–", ""
    elif isinstance(cell, bool):
        text, fraction = ("yes" if cell else "no"), ""
    elif _is_number(cell):
        text, fraction = number(cell, digits), _fraction(cell, digits)  # type: ignore[arg-type]
    else:
        return _inline(str(cell))
    if not width:
        return text
    return f'{text.removesuffix(fraction)}<span class="fraction" style="width:{width}ch">{fraction}</span>'


def _line(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key.replace('_', ' ')} {_line(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_line, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "–" if value is None else str(value)
