"""The servos of simulated robots: the effects of a model over ``[sim, joint]``, one simulation step at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from op3.servo import kernel, rows
from op3.servo.effect import Effect, in_stage_order
from op3.servo.signals import SIGNALS, Periods, Trunk


class Signals:
    """The signals of `op3.servo.signals.SIGNALS`, and the memory of effects, as tensors ``[sim, joint]``.

    Attributes are views of the law's memory; an assignment writes to that memory, with broadcasting.

    Args:
        records: signals of the joints, ``[sim, joint]``.
    """

    __slots__ = ("_views", "records")

    def __init__(self, records: np.ndarray):
        with torch.inference_mode(False):
            views = {name: torch.from_numpy(records[name]) for name in records.dtype.names or ()}
        object.__setattr__(self, "records", records)
        object.__setattr__(self, "_views", views)

    def __getattr__(self, name: str) -> Any:
        try:
            return self._views[name]
        except KeyError:
            raise AttributeError(f"no signal {name!r}; there are {', '.join(SIGNALS)}") from None

    def __setattr__(self, name: str, value: Any) -> None:
        getattr(self, name)[...] = torch.as_tensor(value, dtype=torch.float64).detach()


class Servos:
    """The law of a model's effects for all joints of some simulated robots.

    ``servos.set(values)``; ``servos.reset()``; once per control period fill in commands and ``servos.tick()``; once per
    simulation step fill in position, velocity and load torque, and ``servos.step()``; then pass ``applied_torque``,
    ``damping`` and ``friction_bound`` to the physics. All of these are `signals`.

    Args:
        effects: effects that are on, in any order.
        joints: names of the joints; ``l_`` and ``r_`` begin those of the left and the right side.
        timestep: simulation step [s].
        period: time between ticks [s].

    Attributes:
        signals: signals of the law, ``[sim, joint]``.

    Raises:
        ValueError: if an effect is listed twice, or is not in the catalogue.
    """

    def __init__(self, effects: Sequence[Effect], joints: Sequence[str], num_sims: int, timestep: float, period: float):
        self.effects = in_stage_order(effects)
        self.clock = Periods(timestep, period)
        self.kernel = kernel.current()
        self.on = self.kernel.switches(self.effects)
        self._shape = (num_sims, len(joints))
        self._sides = torch.tensor([_side(name) for name in joints], dtype=torch.float64)
        self.records = np.zeros(self._shape, self.kernel.signals)
        self.signals = Signals(self.records)
        depth = max([effect.depth(self.clock) for effect in self.effects], default=0)
        self.past = np.zeros((*self._shape, max(1, len(self.kernel.deep)), depth))
        self.parameters = self.kernel.rows(self.effects, self.clock, 1, len(joints))
        self._values: Mapping[str, Tensor] = {}

    def reads(self, signal: str) -> bool:
        """Whether an effect reads this signal, so that the simulation must fill it."""
        return any(signal in effect.reads for effect in self.effects)

    def set(self, values: Mapping[str, Tensor]) -> None:
        """Set parameter values, each broadcastable to ``[sim, joint]``, by name.

        Raises:
            ValueError: if a value is missing.
        """
        for effect in self.effects:
            missing = [p.name for p in effect.parameters if p.name not in values]
            if missing:
                raise ValueError(f"effect {effect.name!r} needs values for {', '.join(missing)}")
        for effect in self.effects:
            values = effect.adjust(values, self._sides)
        own = {p.name for effect in self.effects for p in effect.parameters}
        arrays = {name: values[name].detach().numpy() for name in own}
        # one row serves all simulations where these do not differ, and lies nearer to the processor
        alike = all(len(array) == 1 or array.strides[0] == 0 for array in arrays.values())
        self.parameters = self.kernel.rows(self.effects, self.clock, 1 if alike else self._shape[0], self._shape[1])
        for name, array in arrays.items():
            self.parameters[name] = array[:1] if alike else array
        rows.prepare_all(self.parameters, self.on)
        self._values = values

    def reset(self, simulations: np.ndarray | None = None) -> None:
        """Start from the joint state and commands in the signals, as if they had been held for long.

        Args:
            simulations: indices of those that restart; None: all.
        """
        which = np.arange(self._shape[0]) if simulations is None else np.asarray(simulations, np.int64)
        for name in (self.records.dtype.names or ())[len(SIGNALS) :]:
            self.records[name][which] = 0.0
        rows.reset_all(self.records, self.parameters, self.past, self.on, which)

    def tick(self) -> None:
        """A control period begins: read the sensors, compute and send commands."""
        rows.tick_all(self.records, self.parameters, self.past, self.on)

    def step(self) -> None:
        """One simulation step, from the joint state to torque, damping and friction bound."""
        rows.step_all(self.records, self.parameters, self.past, self.on)

    def sense(self) -> None:
        """Compute the sensor readings of the joint state in the signals."""
        rows.sense_all(self.records, self.parameters, self.on)

    def report(self) -> None:
        """Compute the joint state and current that the servos report in a log."""
        rows.report_all(self.records, self.parameters, self.on)

    def balance(self, torque: Tensor, rests: Tensor) -> None:
        """Deflect elastic elements, from the link to the motor, so that joints move as measured.

        Args:
            torque: excess of the last step's torque over that of the measured motion [N m],
                ``[sim, joint]``.
            rests: which joints rest, and are therefore in balance.
        """
        rows.balance_all(self.records, self.parameters, torque.numpy(), rests.numpy(), self.on)

    def sense_trunk(self, trunk: Trunk) -> Trunk:
        """The IMU's readings of the true orientation and rates, which are not changed."""
        seen = Trunk(trunk.quaternion, trunk.angular_velocity)
        for effect in self.effects:
            effect.sense_trunk(seen, self._values)
        return seen


def _side(joint: str) -> float:
    """+1 for a joint of the left side, -1 for one of the right, 0 for one in the middle."""
    return {"l_": 1.0, "r_": -1.0}.get(joint[:2], 0.0)
