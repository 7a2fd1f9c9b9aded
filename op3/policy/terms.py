"""Terms of a task: functions or classes found by name, with the parameters that a configuration gives them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from functools import partial
from math import isfinite
from types import ModuleType
from typing import Any

from torch import Tensor

from op3.common.settings import imported, mistake, nearest, shown

FUNCTION = "function"
"""Field of a term's configuration that names its function or class; by default, the term's name is used."""


class Term:
    """One term: a function of the state and its parameters, or an instance of a class with memory.

    Parameters in the signature without a value in the configuration come from the context: ``robot``, ``scene``,
    ``num_envs`` and others that the caller provides.

    Args:
        kind: kind of the term, for messages.
        spec: its configuration.
        home: module in which short names are looked up.
        context: values of parameters that the configuration need not give.
        options: names and default values of the `options`.
        inputs: number of arguments that are not parameters: the state or, for events, the world and the time.

    Attributes:
        name: name of the term in its task.
        options: fields of the configuration that are not parameters of the function, such as ``weight``.

    Raises:
        ValueError: in one sentence with the term, the field and the nearest name, if the function does not exist, or a
            parameter is unknown or missing.
    """

    def __init__(
        self,
        kind: str,
        name: str,
        spec: Mapping[str, Any],
        home: ModuleType,
        context: Mapping[str, Any],
        options: Mapping[str, Any] | None = None,
        inputs: int = 1,
    ):
        self.name, self.options, self._inputs = name, dict(options or {}), inputs
        self._where = where = f"{kind}.{name}"
        given = dict(spec)
        function = find(given.pop(FUNCTION, name), home, where)
        for option in self.options:
            if option in given:
                self.options[option] = given.pop(option)
        arguments = _arguments(function, inputs)
        wanted = [argument for argument in arguments if argument not in context]
        if unknown := [argument for argument in given if argument not in arguments]:
            known = [*wanted, *self.options]
            raise ValueError(f"{where}.{unknown[0]}: unknown field{nearest(unknown[0], known)}")
        numbers = [argument for argument in given if arguments[argument].annotation in (float, "float")]
        for argument in (*numbers, *self.options):
            if type(value := {**self.options, **given}[argument]) not in (int, float):
                raise ValueError(f"{where}.{argument} must be a number, got {value!r}")
            if argument in self.options and not isfinite(value):
                raise ValueError(f"{where}.{argument} must be finite, got {value!r}")
        offered = {argument: context[argument] for argument in arguments if argument in context}
        required = [a for a in wanted if arguments[a].default is inspect.Parameter.empty and a not in given]
        if required:
            raise ValueError(f"{where}.{required[0]} is missing: give it a value")
        self.parameters: dict[str, Any] = {**offered, **given}
        self.target: Any = function
        if inspect.isclass(function):
            self.target = self._checked(function, **self.parameters)

    @property
    def keeps_memory(self) -> bool:
        """Whether the term is an instance of a class."""
        return not inspect.isroutine(self.target)

    def __call__(self, *inputs: Any) -> Any:
        """The term's value."""
        return self._checked(self.target, *inputs, **({} if self.keeps_memory else self.parameters))

    def hook(self, name: str) -> Callable[..., Any] | None:
        """A method of the instance by its name; None if it has none."""
        method = getattr(self.target, name, None) if self.keeps_memory else None
        return None if method is None else partial(self._checked, method)

    def at(self, time: Tensor) -> Tensor:
        """The value of a command at a time of each episode [s], ``[env, number]``."""
        if (method := self.hook("at")) is None:
            name = getattr(self.target, "__name__", type(self.target).__name__)
            raise ValueError(f"{self._where} must be a class with a method at(time), got {name}")
        value = method(time)
        if not isinstance(value, Tensor) or value.ndim != 2 or len(value) != len(time):
            raise ValueError(f"{self._where} must return [env, number] = ({len(time)}, ...), got {shape_of(value)}")
        return value

    def _checked(self, function: Callable[..., Any], /, *inputs: Any, **parameters: Any) -> Any:
        """Call a user's function and report its errors with term, file and line."""
        try:
            return function(*inputs, **parameters)
        except ValueError as error:
            raise ValueError(f"{self._where}: {str(error).removeprefix(f'{self._where}: ')}") from error
        except MemoryError:
            raise
        except Exception as error:
            raise ValueError(f"{self._where}: {mistake(error, __file__)}") from error

    def set(self, field: str, value: Any) -> None:
        """Change an option or a parameter while the task runs, as a curriculum does."""
        if field in self.options:
            self.options[field] = value
        elif self.keeps_memory and hasattr(self.target, field):
            setattr(self.target, field, value)
        elif not self.keeps_memory and field in _arguments(self.target, self._inputs):
            self.parameters[field] = value
        else:
            target = type(self.target) if self.keeps_memory else self.target
            known = [*self.options, *_arguments(target, self._inputs)]
            raise ValueError(f"{self._where}.{field}: unknown field{nearest(field, known)}")


def shape_of(value: Any) -> str:
    """The shape of a tensor, or any other value as it is."""
    return str(tuple(value.shape)) if isinstance(value, Tensor) else shown(value)


def find(name: Any, home: ModuleType, where: str) -> Callable[..., Any]:
    """A function or class by its dotted path, or by its name in the module with terms of its kind.

    In that module, a class ``TrackVelocity`` has the name ``track_velocity``.
    """
    if not isinstance(name, str):
        raise ValueError(f"{where}.function must be the name of a function, got {name!r}")
    if "." not in name:
        known = {re.sub(r"(?<!^)(?=[A-Z])", "_", key).lower(): getattr(home, key) for key in home.__all__}
        if name not in known:
            raise ValueError(
                f"{where}: there is no term {name!r}{nearest(name, known)}; or give function: package.name"
            )
        return known[name]
    return imported(name, f"{where}.function")


def _arguments(function: Any, inputs: int) -> dict[str, inspect.Parameter]:
    """Parameters that a configuration may set: all parameters of a class, or those of a function after its inputs."""
    found = list(inspect.signature(function).parameters.items())
    found = found if inspect.isclass(function) else found[inputs:]
    return {name: p for name, p in found if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
