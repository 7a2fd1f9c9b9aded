"""Pages of the site from outside docs/ (README.md, CHANGELOG.md, CONTRIBUTING.md), the catalogue of effects from its
classes, and formulae as MathML; a hook of MkDocs (``make docs``)."""

import dataclasses
import html
import inspect
import re
from pathlib import Path
from typing import Any

from op3.rollout.health import checks_table
from op3.rollout.readers import formats_table
from op3.rollout.schema import schema_table
from op3.servo import Effect, Parameter, catalogue

ROOT = Path(__file__).resolve().parents[1]

OF_THE_REPOSITORY = {"index.md": "README.md", "changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}
"""Pages of the site that lie at the top of the repository."""

INTRODUCTION = """\
# The catalogue of effects

Generated from the classes in `op3/servo/effects/`.

A robot model is a list of these effects with values for their parameters (see [servo_model.md](servo_model.md)).
Effects run in the order of their stages. *Range* is the default search range of identification, *start* the value if a
model does not set the parameter. At *neutral* the effect has no influence; a dash means that there is no such value.
A parameter may differ between joints unless it belongs to the whole robot. *Options* are constants of an effect,
set in `model.yaml` and never searched.
"""


def page() -> str:
    """The whole page as Markdown."""
    effects = list(catalogue().values())
    rows = [
        (
            f"[{e.name}](#{e.name})",
            e.stage.name.lower(),
            f"`{e.equation}`",
            ", ".join(f"`{p.name}`" for p in e.parameters),
        )
        for e in effects
    ]
    parts = [INTRODUCTION, table(("effect", "stage", "equation", "parameters"), rows)]
    return "\n".join([*parts, *map(section, effects)])


def section(effect: type[Effect]) -> str:
    """One effect: what it is, its law, where that comes from, its options and parameters."""
    facts = [f"- stage: {effect.stage.name.lower()}", f"- equation: `{effect.equation}`", f"- source: {effect.source}"]
    if options(effect):
        facts.append(f"- options: {', '.join(options(effect))}")
    if effect.edits:
        facts.append(f"- changes in the MuJoCo model: {', '.join(dict.fromkeys(f'`{e.field}`' for e in effect.edits))}")
    if effect.fingerprint:
        facts.append(f"- scopes: {', '.join(effect.scopes)}")
        facts.append(f"- fingerprint: {effect.fingerprint}")
        facts.append(f"- confounders: {', '.join(f'[{name}](#{name})' for name in effect.confounders)}")
        facts.append(f"- distinguished by: {effect.separating_experiment}")
    summary = inspect.cleandoc(effect.__doc__ or "").split("\n\n")[0]
    parts = [f"## {effect.name}", "", " ".join(summary.split()), "", *facts, ""]
    if effect.parameters:
        head = ("parameter", "unit", "range", "start", "neutral", "meaning")
        parts.append(table(head, [parameter_row(p) for p in effect.parameters]))
    return "\n".join(parts)


def options(effect: type[Effect]) -> list[str]:
    """The constructor's keywords with their defaults."""
    return [f"`{field.name} = {field.default}`" for field in dataclasses.fields(effect)]  # type: ignore[arg-type]


def parameter_row(parameter: Parameter) -> tuple[str, ...]:
    """A parameter's cells."""
    return (
        f"`{parameter.name}`",
        "" if parameter.unit == "-" else parameter.unit,
        f"{parameter.low:g} to {parameter.high:g}",
        f"{parameter.nominal:g}",
        "-" if parameter.neutral is None else f"{parameter.neutral:g}",
        parameter.text if parameter.per_joint else f"{parameter.text} (whole robot)",
    )


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """A Markdown table; bars inside cells are escaped."""
    lines = [head, ("---",) * len(head), *(tuple(cell.replace("|", "\\|") for cell in row) for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are not written by hand."""
    from mkdocs.structure.files import File

    for name, source in OF_THE_REPOSITORY.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    files.append(File.generated(config, "catalogue.md", content=page()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Make links of the repository's pages links of the site; files that the site lacks are named alone."""
    if page.file.src_uri == "logs.md":
        tables = {"channels": schema_table(), "formats": formats_table(), "checks": checks_table()}
        return re.sub(r"<!-- table: (\w+) -->", lambda found: tables[found[1]], markdown)
    if page.file.src_uri not in OF_THE_REPOSITORY:
        return markdown
    markdown = markdown.replace("](docs/", "](")
    for name, source in OF_THE_REPOSITORY.items():
        markdown = markdown.replace(f"]({source})", f"]({name})")
    return re.sub(r"\[([^\]]+)\]\((?!https?:|#|[\w/.]+\.md|images/)([^)]+)\)", r"\1 (`\2`)", markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Turn formulae into MathML, which browsers draw by themselves."""
    from latex2mathml.converter import convert

    def drawn(found: re.Match[str]) -> str:
        display = "block" if found[1] == "div" else "inline"
        return convert(html.unescape(found[2]), display=display)

    return re.sub(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', drawn, content, flags=re.DOTALL)
