"""Carries out what effects declare about the MuJoCo model."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from torch import Tensor

from op3.servo import Effect
from op3.sim.ports import ServoPorts


def edited_fields(
    model: mujoco.MjModel,
    effects: Sequence[Effect],
    values: Mapping[str, Tensor],
    ports: ServoPorts,
    base_body: int,
    fields: Mapping[str, np.ndarray],
    num_sims: int,
) -> dict[str, np.ndarray]:
    """Model fields after all edits.

    Args:
        model: compiled model, whose values the edits start from.
        effects: effects that are on.
        values: parameter values ``[sim, joint]`` or ``[sim, 1]``.
        ports: where the servos are.
        base_body: id of the base body, or -1.
        fields: values ``[sim, ...]`` to start from instead of the compiled ones.
        num_sims: number of simulations.

    Returns:
        Arrays ``[sim, ...]`` by field name.

    Raises:
        ValueError: if an effect edits the base of a scene that has none.
    """
    edited = {name: array.copy() for name, array in fields.items()}
    for effect in effects:
        for edit in effect.edits:
            if edit.field not in edited:
                compiled = np.asarray(getattr(model, edit.field), dtype=np.float64)
                edited[edit.field] = np.repeat(compiled[None], num_sims, axis=0)
            value = values[edit.parameter].numpy()
            if edit.target == "joint_dof":
                rows = ports.dof
            elif edit.target == "joint_body":
                rows = ports.body
            elif base_body < 0:
                raise ValueError(f"effect {effect.name!r} changes the base body, but this scene has none")
            else:
                rows, value = base_body, value[:, 0]
            if edit.per is not None:
                value = value * edited.get(edit.per, np.asarray(getattr(model, edit.per))[None])[:, rows]
            if edit.column is None and edited[edit.field].ndim > 2:
                value = value[..., None]
            where = (slice(None), rows) if edit.column is None else (slice(None), rows, edit.column)
            edited[edit.field][where] = value if edit.operation == "set" else edited[edit.field][where] + value
    return edited
