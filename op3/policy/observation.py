"""Observation of a policy: concatenated terms with noise, resolution, delay and history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from op3.policy import observations
from op3.policy.observations import Sensed
from op3.policy.terms import Term, shape_of
from op3.robot import Robot

Terms = Mapping[str, Mapping[str, Any]]
"""Observation terms by name, each with ``function``, its parameters, and the options of `Observer`."""

OPTIONS = {"noise": 0.0, "resolution": 0.0, "delay": 0}
"""Options of an observation term, and their defaults."""


def layout_slices(layout: Mapping[str, int]) -> dict[str, slice]:
    """Slice of each part of one observation on its last axis."""
    edges = pairwise(accumulate(layout.values(), initial=0))
    return {name: slice(first, last) for name, (first, last) in zip(layout, edges, strict=True)}


class Observer:
    """Computes observations from the sensor readings of robots.

    A term's options: ``noise``, standard deviation of a normal distribution added to every number; ``resolution``, the
    step to which numbers are rounded; both in the unit of the term; ``delay``, in policy steps.

    Args:
        terms: terms of one observation, in order.
        history: number of earlier observations that follow the latest, newest first (paper: 1 for balance, 3 for
            walking).
        example: sensor readings of one robot, ``[1, ...]``, which determine the widths of the terms.

    Attributes:
        layout: name and width of each term, in order.

    Raises:
        ValueError: if a term does not exist or does not fit the robot, or an option is invalid; names the term.
    """

    def __init__(self, terms: Terms, robot: Robot, history: int, example: Sensed):
        if history < 0:
            raise ValueError(f"history must be at least 0, got {history}")
        context = {"robot": robot}
        self.terms = [Term("observations", n, s or {}, observations, context, OPTIONS) for n, s in terms.items()]
        self.layout: dict[str, int] = {}
        for term in self.terms:
            _check_options(term)
            where = f"observations.{term.name}"
            try:
                value = term(example)
            except ValueError as error:
                problem = str(error).removeprefix(f"{where}: ")
                raise ValueError(f"{where} does not fit the robot {robot.name}: {problem}") from error
            if not isinstance(value, Tensor) or value.shape[:-1] != example.joint_position.shape[:-1]:
                raise ValueError(f"{where} must return [..., number], for one robot (1, number), got {shape_of(value)}")
            self.layout[term.name] = value.shape[-1]
        self.history = history
        self._late: dict[str, list[Tensor]] = {}
        self._stack: Tensor | None = None

    @property
    def size(self) -> int:
        """Numbers in the policy's observation, with history."""
        return sum(self.layout.values()) * (self.history + 1)

    def reset(
        self, sensed: Sensed, rows: Tensor | None = None, noise: Sequence[np.random.Generator] | None = None
    ) -> Tensor:
        """Start episodes; the first observation is repeated for those before it.

        Args:
            rows: mask over the first axis of robots whose episodes start; None for all.
            noise: generator of each robot; None: no noise.

        Returns:
            The observation, ``[..., (history + 1) * observation]``.
        """
        now = self._observe(sensed, rows, noise)
        filled = torch.stack([now] * (self.history + 1), -2)
        if rows is not None and self._stack is not None:
            filled = torch.where(rows.view(-1, *[1] * (filled.ndim - 1)), filled, self._stack)
        self._stack = filled
        return filled.flatten(-2)

    def push(self, sensed: Sensed, noise: Sequence[np.random.Generator] | None = None) -> Tensor:
        """The observation after a policy step, ``[..., (history + 1) * observation]``.

        Raises:
            RuntimeError: if `reset` was not called before.
        """
        if self._stack is None:
            raise RuntimeError("call reset(sensed) before the first step")
        now = self._observe(sensed, None, noise, begins=False)
        self._stack = torch.cat([now[..., None, :], self._stack[..., :-1, :]], -2)
        return self._stack.flatten(-2)

    def _observe(
        self,
        sensed: Sensed,
        rows: Tensor | None,
        noise: Sequence[np.random.Generator] | None,
        begins: bool = True,
    ) -> Tensor:
        parts = []
        for term in self.terms:
            value = term(sensed).to(torch.float64)
            deviation, resolution = term.options["noise"], term.options["resolution"]
            if deviation and noise is not None:
                drawn = np.stack([generator.standard_normal(value.shape[-1]) for generator in noise])
                value = value + deviation * torch.from_numpy(drawn).view(value.shape).to(value)
            if resolution:
                value = torch.round(value / resolution) * resolution
            parts.append(self._delayed(term, value, rows, begins) if term.options["delay"] else value)
        return torch.cat(parts, -1)

    def _delayed(self, term: Term, value: Tensor, rows: Tensor | None, begins: bool) -> Tensor:
        """The value some steps earlier; at the start of an episode the first value."""
        earlier = self._late.get(term.name)
        if begins:
            fresh = [value] * (term.options["delay"] + 1)
            if rows is not None and earlier is not None:
                fresh = [torch.where(rows[:, None], value, old) for old in earlier]
            self._late[term.name] = fresh
        else:
            assert earlier is not None
            self._late[term.name] = [*earlier[1:], value]
        return self._late[term.name][0]


def _check_options(term: Term) -> None:
    for name, value in term.options.items():
        if not isinstance(value, int | float) or isinstance(value, bool) or not value >= 0:
            raise ValueError(f"observations.{term.name}.{name} must be a number of at least 0, got {value!r}")
    if term.options["delay"] != int(term.options["delay"]):
        raise ValueError(f"observations.{term.name}.delay must be whole policy steps, got {term.options['delay']!r}")
    term.options["delay"] = int(term.options["delay"])
