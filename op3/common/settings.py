"""Settings and their files, checked by pydantic; every error is one sentence.

A group of settings is a frozen dataclass whose fields have the types below:

    @settings("limits")
    class Limits:
        voltage: Positive = 10.0
        coast_ticks: Whole = 3
        joints: tuple[str, ...] = ()

    Limits(voltage=-1)  # ValueError: limits: voltage must be above 0, got -1

Relations between fields are checked in ``__post_init__``, as in any dataclass.
"""

import difflib
import functools
import importlib
import re
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, dataclass_transform, get_args, get_origin

import pydantic
import pydantic.dataclasses
import yaml
from pydantic import AfterValidator, BeforeValidator, Field


def _plain(value: Any) -> Any:
    """Numpy's scalars as Python's; lists of any type, also Hydra's, as tuples."""
    if getattr(value, "ndim", None) == 0 and hasattr(value, "item"):
        return value.item()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return tuple(value)
    return value


def _unfractioned(value: Any) -> Any:
    """Converts a float without a fraction, such as YAML's 1e6, to an integer."""
    value = _plain(value)
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _mapping(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else value


Number = Annotated[float, BeforeValidator(_plain), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
Whole = Annotated[int, BeforeValidator(_unfractioned), Field(ge=0)]
Count = Annotated[int, BeforeValidator(_unfractioned), Field(ge=1)]
Text = Annotated[str, Field(min_length=1)]

GAIN_LOW = 0.1
"""Lowest P gain that a policy commands [A/rad] (paper Sec. action space)."""

GAIN_HIGH = 6.0
"""Highest P gain [A/rad] (paper Sec. action space)."""

CONTROL_PERIOD = 0.008
"""Time between ticks of the PD on the robot's computer [s] (paper, 125 Hz)."""

Gain = Annotated[Number, Field(ge=GAIN_LOW, le=GAIN_HIGH)]

_Item = TypeVar("_Item")
_Group = TypeVar("_Group")

Listed = Annotated[tuple[_Item, ...], BeforeValidator(_plain)]
"""Several values of one type: ``Listed[Number]``; a list becomes a tuple."""

Some = Annotated[tuple[_Item, ...], BeforeValidator(_plain), Field(min_length=1)]
"""One or more values of one type."""

Named = Annotated[Mapping[str, _Item], BeforeValidator(_mapping), AfterValidator(dict)]
"""Values by name: ``Named[Positive]``."""

Raise = Callable[[str, str, Any], Exception]
"""Builds the error from a field, its requirement and the given value."""

_WANTED = {
    "greater_than": "above {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "below {lt:g}",
    "less_than_equal": "at most {le:g}",
    "float_type": "a number",
    "float_parsing": "a number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_parsing": "true or false",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "bool_type": "true or false",
    "string_type": "text (quote it if it looks like a number)",
    "string_too_short": "text that is not empty",
    "literal_error": "one of {expected}",
    "tuple_type": "a list",
    "too_short": "a list of length {min_length} or more",
    "too_long": "a list of {max_length}",
    "mapping_type": "a mapping of names to values",
    "dict_type": "a mapping of names to values",
    "dataclass_type": "a mapping of its fields",
    "model_type": "a mapping of its fields",
    "invalid_key": "under a name",
    "string_pattern_mismatch": "text of the form {pattern}",
}
"""Pydantic's kinds of error, as text that follows "must be"."""


@dataclass_transform(frozen_default=True)
def settings(what: str = "", raises: Raise | None = None) -> Callable[[type[_Group]], type[_Group]]:
    """Make a class a frozen dataclass whose fields are checked.

    Types are strict: true is not a number and "3" is not 3, but an integer is accepted as a number.

    Args:
        what: subject of the settings, which precedes the field in messages; empty if the field is clear without it.
        raises: function that creates the error of one field; None: a ValueError.
    """
    before = f"{what}: " if what else ""

    def decorate(cls: type[_Group]) -> type[_Group]:
        config = pydantic.ConfigDict(strict=True, arbitrary_types_allowed=True, extra="forbid")
        made: Any = pydantic.dataclasses.dataclass(cls, frozen=True, config=config)
        checked = made.__init__

        @functools.wraps(checked)
        def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
            try:
                checked(self, *args, **kwargs)
            except pydantic.ValidationError as error:
                raise refused(error) from None

        def refused(error: pydantic.ValidationError) -> Exception:
            place, given, wanted, problem = first_fault(error, made)
            field = ".".join(map(str, place))
            if isinstance(problem, Exception):  # op3's own check, whose message is complete
                return problem
            return raises(field, wanted, given) if wanted and raises else ValueError(f"{before}{field} {problem}")

        made.__init__ = __init__
        return made

    return decorate


class Fault(NamedTuple):
    """Place of an error, the given value, the requirement (empty if the value is not the problem), and a text that
    follows the field's name, or the error of op3's own check."""

    place: tuple[str | int, ...]
    given: Any
    wanted: str
    problem: str | Exception


def first_fault(error: pydantic.ValidationError, kind: Any) -> Fault:
    """The first error that pydantic reports in a dataclass or record of this kind."""
    detail: Any = max(error.errors(), key=lambda found: found["type"] == "extra_forbidden")  # explains what is missing
    place, given, name, context = tuple(detail["loc"]), detail["input"], detail["type"], detail.get("ctx", {})
    place = tuple("/".join(step) if isinstance(step, tuple) else step for step in place)  # a key of several parts
    if place and isinstance(place[0], int):  # it was given by its place, not by name
        place = (list(kind.__pydantic_fields__)[place[0]], *place[1:])
    if name == "value_error":
        return Fault(place, given, "", context["error"])
    if name in ("unexpected_keyword_argument", "extra_forbidden"):
        return Fault(place, given, "", f"is not a field{nearest(place[-1], _fields(kind, place))}")
    if name in ("missing", "missing_argument"):
        wanted = getattr(_fields(kind, place).get(place[-1]), "annotation", None)
        entry = f"{place[-1]}: {get_args(wanted)[0]}" if get_origin(wanted) is Literal else "it"
        return Fault(place, given, "", f"is missing; add {entry}")
    wanted = _WANTED[name].format(**context) if name in _WANTED else f"valid ({detail['msg']})"
    return Fault(place, given, wanted, f"must be {wanted}, got {shown(given)}")


def _fields(kind: Any, place: Sequence[str | int]) -> Mapping[Any, Any]:
    """Fields of the record that contains an entry."""
    for step in place[:-1]:
        known = getattr(kind, "__pydantic_fields__", {})
        parts = _parts(known[step].annotation if step in known else kind)
        kind = next((part for part in parts if hasattr(part, "__pydantic_fields__")), parts[0])
    return getattr(kind, "__pydantic_fields__", {})


def _parts(annotation: Any) -> list[Any]:
    """An annotation and everything between its brackets."""
    return [annotation, *(part for inner in getattr(annotation, "__args__", ()) for part in _parts(inner))]


def shown(value: Any) -> str:
    """A value as messages quote it, truncated if long."""
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


def nearest(name: object, known: Iterable[str]) -> str:
    """Hint after an unknown name: the nearest valid name, otherwise all valid names."""
    known = list(known)
    close = difflib.get_close_matches(str(name), known, n=1)
    return f"; the nearest is {close[0]!r}" if close else f"; there are {', '.join(known) or 'none'}"


def imported(name: str, where: str) -> Any:
    """A function or class by its dotted path; raises a ValueError with the field and the nearest name if there is
    none."""
    module, _, attribute = name.rpartition(".")
    try:
        home = importlib.import_module(module)
    except (ImportError, ValueError) as error:
        raise ValueError(f"{where}: {name!r} cannot be imported ({error}); correct the path") from None
    if not callable(found := getattr(home, attribute, None)):
        known = [key for key in getattr(home, "__all__", vars(home)) if callable(getattr(home, key))]
        raise ValueError(f"{where}: {module} has no {attribute!r}{nearest(attribute, known)}")
    return found


def mistake(error: Exception, caller: str) -> str:
    """An error in a function that a user wrote: its type, file and line, its message, and the nearest name.

    Args:
        caller: file that called the function; an error raised there has no line in the user's code.
    """
    frame = traceback.extract_tb(error.__traceback__)[-1]
    place = "" if frame.filename == caller else f" in {Path(frame.filename).name}, line {frame.lineno}"
    close = ""
    if isinstance(error, AttributeError) and error.name:
        close = nearest(error.name, [name for name in dir(error.obj) if not name.startswith("_")])
    return f"{type(error).__name__}{place}: {error}{close}"


_SCALARS = {
    "bool": (r"true|True|TRUE|false|False|FALSE", "tTfF"),
    "int": (r"[-+]?[0-9]+", "-+0123456789"),
    "float": (
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+.0123456789",
    ),
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
}
"""Patterns of plain values of YAML 1.2, and their first characters."""

_MOST_ALIASES = 20
"""Largest number of aliases: nested lists of aliases could otherwise fill the memory."""


class _Loader(yaml.SafeLoader):
    """YAML 1.2: 1e-3 is a number, `on` a name, and duplicate keys are refused.

    PyYAML reads YAML 1.1, in which 1e-3 is a text, `no` is false and 1:30 is ninety; of two equal keys it uses the
    last.
    """

    yaml_implicit_resolvers: dict[Any, Any] = {}
    aliases = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self.aliases += self.check_event(yaml.AliasEvent)
        if self.aliases > _MOST_ALIASES:
            raise yaml.composer.ComposerError(None, None, "too many aliases", self.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_once(self, node: yaml.MappingNode) -> dict[Any, Any]:
        """A mapping whose keys differ."""
        lines: dict[str, int] = {}
        for key, _ in node.value:
            line = key.start_mark.line + 1
            if isinstance(key, yaml.ScalarNode):
                if key.value in lines:
                    raise _Twice(key.value[:60], lines[key.value], line)
                lines[key.value] = line
        return self.construct_mapping(node, deep=True)


class _Twice(Exception):
    """A duplicate key, and its two lines."""


for _name, (_pattern, _first_letters) in _SCALARS.items():
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_name}", re.compile(f"^(?:{_pattern})$"), [*_first_letters])
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))
_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.construct_once)


def _yaml_error(problem: str, remedy: str, *, source: object, column: str | None = None) -> Exception:
    return ValueError(f"{source}{f', {column}' if column else ''}: {problem}; {remedy}")


def read_yaml(path: str | Path, raises: Callable[..., Exception] = _yaml_error) -> dict[str, Any]:
    """The mapping in a YAML file.

    Args:
        path: path of the file.
        raises: function that creates the error from problem, remedy and location (`source`, `column`).

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if it is not UTF-8 text, not YAML (with the line) or not a mapping of names to values; or the error
            from `raises`.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}: correct the path")
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError:
        raise raises("the file is not UTF-8 text", "write a YAML file there", source=path) from None
    except OSError as error:
        raise raises(f"the file cannot be read ({error.strerror})", "correct the path", source=path) from None
    return parse_yaml(text, path, raises)


def parse_yaml(text: str, source: str | Path, raises: Callable[..., Exception] = _yaml_error) -> dict[str, Any]:
    """The mapping in a YAML text; errors are as in `read_yaml` and name `source`."""
    try:
        values = yaml.load(text, Loader=_Loader)
    except _Twice as error:
        key, first, line = error.args
        problem = f"the key is on line {first} and again on line {line}"
        raise raises(problem, "keep the correct one", source=source, column=f"field {key}") from None
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise raises(f"line {line} is not valid YAML ({error.problem})", "correct it", source=source) from None
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError, AttributeError, TypeError):
        # PyYAML does not wrap errors of its value constructors
        remedy = "write plain `name: value` lines with valid numbers"
        raise raises("the text is not valid YAML", remedy, source=source) from None
    if not isinstance(values, dict):
        kind = "empty" if values is None else f"a {type(values).__name__}"
        raise raises(f"the file is {kind}, not a mapping", "write one `name: value` per line", source=source)
    for name in values:
        if not isinstance(name, str):
            raise raises(f"the key {name!r} is not text", "write one `name: value` per line", source=source)
    return values
