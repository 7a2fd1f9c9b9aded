"""Inputs of a simulation: commands, and parameter values per simulation and joint."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from op3.servo import RobotModel, Signals

COMMANDS = ("position_target", "p_gain", "d_gain", "firmware_gain", "torque_enable", "bus_voltage", "temperature")
"""Inputs of the servo law that are held between ticks."""

REFERENCE_TEMPERATURE = 25.0
"""Temperature assumed without a measurement [C], at which a model's parameters are valid."""


def steps_in(period: float, timestep: float) -> int:
    """Number of simulation steps in a period [s]; raises a ValueError if it is not a multiple of the time step [s]."""
    steps = round(period / timestep)
    if steps < 1 or abs(steps * timestep - period) > 1e-9:
        raise ValueError(f"control_period {period} s must be a multiple of the time step {timestep} s")
    return steps


def fresh_start(signals: Signals, model: RobotModel, rows: Any = slice(None)) -> None:
    """Initial inputs before any command: torque on, zero gains, the joints' positions, the model's voltage, 25 C."""
    for name in (*COMMANDS, "current", "time"):
        getattr(signals, name)[rows] = 0.0
    signals.position_target[rows] = signals.position[rows]
    signals.torque_enable[rows] = 1.0
    signals.bus_voltage[rows] = model.bus_voltage
    signals.temperature[rows] = REFERENCE_TEMPERATURE


def set_commands(signals: Signals, commands: Mapping[str, Any], rows: Any = slice(None)) -> None:
    """Write commands, each broadcastable to ``[sim, joint]``, into the signals.

    Raises:
        ValueError: if a command is unknown.
    """
    for name, value in commands.items():
        if name not in COMMANDS:
            raise ValueError(f"unknown command {name!r}; commands are {', '.join(COMMANDS)}")
        # physics has no gradients; a policy's actions may
        getattr(signals, name)[rows] = torch.as_tensor(value, dtype=torch.float64).detach()


def expand_parameters(
    model: RobotModel, joints: Sequence[str], values: Mapping[str, Tensor | float], num_sims: int
) -> dict[str, Tensor]:
    """All parameters of a model, ``[sim, joint]``, or ``[sim, 1]`` for parameters of the whole robot.

    Args:
        model: model with all other values.
        values: values by parameter name, ``[sim]`` or ``[sim, joint]`` or a number.

    Raises:
        ValueError: if the model has no such parameter, or a shape does not fit.
    """
    known = model.parameters()
    full = model.tensors(joints)
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"the model has no parameter {name!r}; it has {', '.join(known)}")
        value = torch.as_tensor(value, dtype=torch.float64)
        full[name] = value.view(-1, 1) if value.ndim < 2 else value
    shape = (num_sims, len(joints))
    try:
        return {name: value.expand(shape if known[name].per_joint else (num_sims, 1)) for name, value in full.items()}
    except RuntimeError as error:
        raise ValueError(f"parameter values must be [sim] or [sim, joint] with {shape}: {error}") from error
