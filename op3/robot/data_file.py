"""YAML files checked by pydantic; every error is one sentence with file, line, field and the nearest valid name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, TypeVar

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from op3.common.settings import first_fault, nearest, parse_yaml

Content = TypeVar("Content", bound="Record")


Real = Annotated[float, Field(strict=True)]
"""A number; texts and booleans are not accepted."""


class Record(BaseModel):
    """Part of a data file with exactly these fields, immutable after reading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    split_from: ClassVar[Mapping[str, str]] = {}
    """Fields with a part of another entry of the file, and that entry."""


def among(what: str, known: Iterable[str]) -> AfterValidator:
    """Validator that a field's text is a known name of this kind."""

    def check(name: str) -> str:
        if name not in known:
            raise ValueError(f"names the {what} {name!r}, which does not exist{nearest(name, known)}")
        return name

    return AfterValidator(check)


class DataFileError(ValueError):
    """A data file has an invalid entry."""


class DataFile:
    """A YAML file with the line of every entry.

    Raises:
        DataFileError: if the file does not exist or is not YAML.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        try:
            text = self.path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "not UTF-8 text"
            raise DataFileError(f"{self.path} cannot be read: {reason}") from None
        try:
            self.content = parse_yaml(text, self.path)
        except ValueError as error:
            raise DataFileError(str(error)) from None
        self._tree = yaml.compose(text, yaml.SafeLoader)

    def line(self, place: Sequence[str | int] = ()) -> int:
        """Line of an entry, such as ``("joints", "elbow", "limits")``, or of its nearest existing parent."""
        node, line = self._tree, 1
        for step in place:
            below = _step(node, step)
            if below is None:
                break
            line, node = below
        return line

    def fault(self, place: Sequence[str | int], problem: str) -> DataFileError:
        """The error for an entry."""
        field = ".".join(str(step) for step in place)
        return DataFileError(f"{self.path}, line {self.line(place)}: {field + ' ' if field else ''}{problem}")

    def unknown(self, place: Sequence[str | int], what: str, name: str, known: Iterable[str]) -> DataFileError:
        """The error for an unknown name in an entry, with the nearest known name."""
        return self.fault(place, f"names the {what} {name!r}, which does not exist{nearest(name, known)}")

    def read(self, kind: type[Content]) -> Content:
        """The validated content of the file.

        Raises:
            DataFileError: the first error in the file.
        """
        try:
            return kind.model_validate(self.content)
        except ValidationError as error:
            (field, *inner), *_, problem = first_fault(error, kind)
            raise self.fault((kind.split_from.get(str(field), field), *inner), str(problem)) from None


def _step(node: yaml.Node | None, step: str | int) -> tuple[int, yaml.Node] | None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if key.value == str(step):
                return key.start_mark.line + 1, value
    if isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value):
        return node.value[step].start_mark.line + 1, node.value[step]
    return None
