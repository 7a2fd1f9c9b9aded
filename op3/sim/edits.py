"""Applies the changes of the MuJoCo model that effects declare."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
from torch import Tensor

from op3.servo import Effect, ModelEdit
from op3.servo.effects import LinkInertia, Motor
from op3.sim.ports import ServoPorts

ROTOR, LINK = Motor.edits[0], LinkInertia.edits[0]
"""Changes that need no MuJoCo: the rotor's inertia, on the diagonal of the mass matrix, and a link's inertia."""


def edited_fields(
    model: mujoco.MjModel,
    effects: Sequence[Effect],
    values: Mapping[str, Tensor],
    ports: ServoPorts,
    base_body: int,
    num_sims: int,
) -> dict[str, np.ndarray]:
    """Model fields after all edits, ``[sim, ...]`` by name.

    Args:
        model: compiled model, whose values the edits start from.
        values: values of parameters, ``[sim, joint]`` or ``[sim, 1]``.
        base_body: id of the base body, or -1.

    Raises:
        ValueError: if an effect edits the base but the scene has none.
    """
    edited: dict[str, np.ndarray] = {}
    for effect in effects:
        for edit in effect.edits:
            if edit.field not in edited:
                compiled = np.asarray(model_field(model, edit.field), dtype=np.float64)
                compiled = compiled[None] if edit.target == "option" else compiled
                edited[edit.field] = np.repeat(compiled[None], num_sims, axis=0)
            if edit.target == "base_body" and base_body < 0:
                raise ValueError(f"effect {effect.name!r} changes the base body, but this scene has none")
            value = values[edit.parameter].numpy()
            rows = _rows(model, edit, ports, base_body)
            if edit.per is not None:  # compiled values, so that the order of effects does not matter
                value = value * np.asarray(getattr(model, edit.per))[None, rows]
            _carry_out(edit, edited[edit.field], rows, value)
    return {name: array[:, 0] if name.startswith("opt.") else array for name, array in edited.items()}


def model_field(model: mujoco.MjModel, field: str) -> np.ndarray:
    """The live array of a field, whose name may have parts, as in ``opt.gravity``."""
    return attrgetter(field)(model)


def _rows(model: mujoco.MjModel, edit: ModelEdit, ports: ServoPorts, base_body: int) -> Any:
    one_of = {
        "joint_dof": ports.dof,
        "joint_body": ports.body,
        "base_body": slice(base_body, base_body + 1),
        "option": slice(0, 1),
    }
    if edit.target in one_of:
        return one_of[edit.target]
    # the ground: the floor and moving boards; its priority gives it precedence over the feet
    collides, roots = (model.geom_contype | model.geom_conaffinity) != 0, model.body_rootid
    return np.flatnonzero(collides & ~np.isin(roots[model.geom_bodyid], roots[ports.body]))


def _carry_out(edit: ModelEdit, field: np.ndarray, rows: Any, value: np.ndarray) -> None:
    """Write one edit into ``field`` ``[sim, row]`` or ``[sim, row, column]``; `value` is ``[sim, row | 1]``."""
    if edit.operation == "turn":
        vectors = field[:, rows]
        second, third = (edit.column + 1) % 3, (edit.column + 2) % 3  # type: ignore[operator]
        cos, sin = np.cos(value), np.sin(value)
        y, z = vectors[..., second].copy(), vectors[..., third].copy()
        vectors[..., second], vectors[..., third] = cos * y + sin * z, cos * z - sin * y
        field[:, rows] = vectors
        return
    if edit.column is None and field.ndim > 2:
        value = value[..., None]
    where = (slice(None), rows) if edit.column is None else (slice(None), rows, edit.column)
    if edit.operation == "set":
        field[where] = value
    elif edit.operation == "add":
        field[where] = field[where] + value
    else:
        field[where] = field[where] * (1.0 + value)
