"""Many pendulums on servos, stepped in closed form, without a physics engine.

A pendulum on one hinge needs no constraint solver: friction is a bound on an impulse that may stop the joint and
never reverse it. It steps an order of magnitude faster than one MuJoCo model per run, which pays when a fit simulates
thousands of bench runs. The servo law is the same; `tests/sim/test_pendulum_simulation.py` compares it with MuJoCo.
"""

from collections.abc import Mapping
from math import copysign, cos, hypot, sin
from typing import Any

import numpy as np
import torch
from torch import Tensor

from op3.common.settings import CONTROL_PERIOD
from op3.robot.register_units import GRAVITY
from op3.servo import RobotModel, Servos
from op3.servo.machine_code import entry
from op3.sim.edits import LINK, ROTOR
from op3.sim.inputs import expand_parameters, fresh_start, set_commands
from op3.sim.trunk_sensors import readings, undo_sensing


class PendulumSimulation:
    """Pendulums with the interface of `op3.sim.BatchSimulation`; all tensors are ``[sim, 1]``.

    ``(J_l + J_r + h D) dw = h (tau - m g l sin q - friction)`` per step ``h``, with the link's inertia
    ``J_l = m l^2 + m k^2``, the rotor's ``J_r`` and the motor's implicit damping ``D``; then ``q += h w``.

    Args:
        model: effects and parameter values; effects of trunk or floor do not apply.
        mass: mass of the weights [kg], ``[sim]``.
        length: distance from shaft to weight [m], ``[sim]``.
        timestep: simulation step [s], in which a servo's own position loop runs once; a PD that commands current
            ticks every `op3.common.settings.CONTROL_PERIOD`.

    Raises:
        ValueError: if the model has an effect on a part that a bench does not have.
    """

    joint_names = ("servo",)

    def __init__(self, model: RobotModel, mass: Tensor, length: Tensor, *, timestep: float = 0.001):
        for effect in model.effects:
            for edit in effect.edits:
                if edit not in (ROTOR, LINK):
                    raise ValueError(
                        f"effect {effect.name!r} changes {edit.field} of {edit.target}, which a bench does not have;"
                        " omit the effect, or use a model of one servo, such as model=rhoban_m1"
                    )
        self.model = model
        self.timestep = timestep
        # the PD on a computer has its own period; a servo's own loop runs in every step
        self._every = round(CONTROL_PERIOD / timestep) if "current_pd" in model.effect_names else 1
        self._steps = 0
        self.num_sims = len(mass)
        self._mass, self._length = (value.to(torch.float64).view(-1, 1) for value in (mass, length))
        self._moment = self._mass * GRAVITY * self._length
        self.law = Servos(model.effects, self.joint_names, self.num_sims, timestep, self._every * timestep)
        self.signals = self.law.signals
        fresh_start(self.signals, model)
        self.failed = torch.zeros(self.num_sims, dtype=torch.bool)
        self.set_parameters({})

    def set_parameters(self, values: Mapping[str, Tensor | float]) -> None:
        """Set parameters per simulation, as `op3.sim.BatchSimulation.set_parameters` does."""
        self.parameters = expand_parameters(self.model, self.joint_names, values, self.num_sims)
        self.law.set(self.parameters)
        none = torch.zeros(self.num_sims, 1, dtype=torch.float64)
        inertia = self._mass * (self._length**2 + self.parameters.get(LINK.parameter, none))
        total = inertia + self.parameters.get(ROTOR.parameter, none)
        self._body = torch.cat([self._mass, self._length, inertia, total], 1).numpy()

    def reset(
        self,
        position: Any,
        commands: Mapping[str, Any] | None = None,
        velocity: Any = 0.0,
        *,
        measured: bool = False,
    ) -> None:
        """Restart all pendulums; arguments as for `op3.sim.BatchSimulation.reset`."""
        signals = self.signals
        signals.position = position
        if measured:
            undo_sensing(self.law, signals.position.clone())
        signals.velocity = velocity
        signals.load_torque = -self._moment * torch.sin(signals.position)
        signals.radial_force = self._mass * GRAVITY
        fresh_start(signals, self.model)
        set_commands(signals, commands or {})
        self._steps = 0
        self.failed = torch.zeros(self.num_sims, dtype=torch.bool)
        self.law.reset()

    def command(self, **commands: Any) -> None:
        """Set commands for the next steps; all others are held."""
        set_commands(self.signals, commands)

    def advance(self) -> None:
        """One step."""
        if self._steps % self._every == 0:
            self.law.tick()
        self.law.step()
        swing(self.law.records, self._body, self.timestep)
        self._steps += 1

    def measure(self) -> dict[tuple[str, str], Tensor]:
        """Current readings of the servo's sensors: channels of the log, ``[sim, 1]``."""
        channels, signals = readings(self.law), self.signals
        self.failed |= ~(torch.isfinite(signals.position) & (signals.position.abs() < 1e3))[:, 0]
        return {**channels, ("joint", "duty"): signals.duty * signals.torque_enable}


@entry
def swing(s, body, step):
    """Integrate a step with the outputs of the law.

    Args:
        s: signals, ``[sim, 1]``.
        body: mass [kg], length [m], inertia of the weight, and total inertia with the rotor [kg m^2], ``[sim, 4]``.
        step: step length [s].
    """
    for i in range(s.shape[0]):
        one = s[i, 0]
        mass, length, link, total = body[i, 0], body[i, 1], body[i, 2], body[i, 3]
        gravity = -mass * GRAVITY * length * sin(one.position)
        inertia = total + step * one.damping
        free = one.velocity + step * (one.applied_torque + gravity) / inertia
        # friction reduces the speed by at most its impulse
        velocity = copysign(np.maximum(abs(free) - step * one.friction_bound / inertia, 0.0), free)
        # the transmitted torque moves the link against gravity; its reaction loads the servo
        acceleration = (velocity - one.velocity) / step
        one.load_torque = gravity - link * acceleration
        # the weight's acceleration along the arm and across it, less gravity's
        along = GRAVITY * cos(one.position) + length * one.velocity * one.velocity
        one.radial_force = mass * hypot(along, GRAVITY * sin(one.position) + length * acceleration)
        one.velocity = velocity
        one.position += step * velocity
