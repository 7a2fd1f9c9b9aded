"""Many pendulums on servos, stepped in closed form: the bench without a physics engine.

A pendulum on one hinge needs no constraint solver: friction is a bound on an impulse that may stop the joint and
never reverse it. Written as tensors over all runs and candidates it steps an order of magnitude faster than one
MuJoCo model per run, which pays when a fit simulates thousands of bench runs. The servo law is the same object;
`tests/sim/test_pendulum_simulation.py` holds it against MuJoCo.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from op3.robot.units import GRAVITY
from op3.servo import RobotModel, ServoLaw, Signals
from op3.servo.effects import LinkInertia, Motor
from op3.sim.inputs import default_commands, expand_parameters, set_commands, set_start
from op3.sim.translated import Translated

PD_PERIOD = 0.008
"""Time between ticks of a PD that commands current [s]; paper, 125 Hz."""

TRANSLATED_AFTER = 50
"""Steps in torch after a reset before numpy takes over; a shorter run does not pay for the translation."""

REPORTED = ("position", "velocity", "voltage", "current", "duty")
"""Signals to be read from a simulation."""

ROTOR, LINK = Motor.edits[0], LinkInertia.edits[0]
"""The changes to a MuJoCo model that mean something here: of the rotor's inertia and of the link's."""


class PendulumSimulation:
    """Pendulums with the interface of `op3.sim.BatchSimulation`; all tensors are ``[sim, 1]``.

    ``(J_l + J_r + h D) dw = h (tau - m g l sin q - friction)`` per step ``h``, with the link's inertia
    ``J_l = m l^2 + m k^2``, the rotor's ``J_r`` and the motor's implicit damping ``D``; then ``q += h w``.

    Args:
        model: effects and parameter values; effects of trunk or floor have no meaning here.
        mass: of the weights [kg], ``[sim]``.
        length: from shaft to weight [m], ``[sim]``.
        timestep: simulation step [s], in which a servo's own position loop runs once; a PD that commands current
            ticks every `PD_PERIOD`.
        translated: whether long runs are translated to numpy where they can be, which takes half the time or less.

    Raises:
        ValueError: if the model has an effect that changes what a bench does not have.
    """

    joint_names = ("servo",)

    def __init__(
        self,
        model: RobotModel,
        mass: Tensor,
        length: Tensor,
        *,
        timestep: float = 0.001,
        translated: bool = True,
    ):
        for effect in model.effects:
            for edit in effect.edits:
                if edit not in (ROTOR, LINK):
                    raise ValueError(
                        f"effect {effect.name!r} changes {edit.field} of {edit.target}, but a bench has no such thing;"
                        " leave the effect out"
                    )
        self.model = model
        self.timestep = timestep
        # the PD on a computer has its own period; a servo's own loop runs in every step
        self._every = round(PD_PERIOD / timestep) if "current_pd" in model.effect_names else 1
        self._steps = 0
        self._translate = translated and self._every == 1
        self._translated: Translated | None = None
        self.num_sims = len(mass)
        self._mass, self._length = mass.view(-1, 1), length.view(-1, 1)
        self._moment = self._mass * GRAVITY * self._length
        self.law = ServoLaw(model.effects, timestep, self._every * timestep, self.joint_names)
        self._reads_force = self.law.reads("radial_force")
        self.signals = Signals.zeros(self.num_sims, 1)
        default_commands(self.signals, model)
        self.failed = torch.zeros(self.num_sims, dtype=torch.bool)
        self.set_parameters({})

    def set_parameters(self, values: Mapping[str, Tensor | float]) -> None:
        """Give parameters per simulation, as `op3.sim.BatchSimulation.set_parameters` does."""
        self.parameters = expand_parameters(self.model, self.joint_names, values, self.num_sims)
        self._translated = None
        self.law.set_parameters(self.parameters)
        none = torch.zeros(self.num_sims, 1, dtype=torch.float64)
        gyration_squared = self.parameters.get(LINK.parameter, none)
        self._inertia = self._mass * self._length**2 + self._mass * gyration_squared
        self._total = self._inertia + self.parameters.get(ROTOR.parameter, none)

    def reset(
        self,
        position: Any,
        commands: Mapping[str, Any] | None = None,
        velocity: Any = 0.0,
        *,
        measured: bool = False,
        load_torque: Any = None,
        current: Any = None,
        time: Any = 0.0,
    ) -> None:
        """Start all pendulums anew; arguments as for `op3.sim.BatchSimulation.reset`."""
        signals = self.signals
        zeros = torch.zeros(self.num_sims, 1, dtype=torch.float64)
        signals.position = torch.as_tensor(position, dtype=torch.float64).expand_as(zeros).clone()
        signals.velocity = torch.as_tensor(velocity, dtype=torch.float64).expand_as(zeros).clone()
        if measured:
            reading = signals.position
            for _ in range(3):
                self.law.sense(signals)
                signals.position = signals.position + reading - signals.measured_position
        signals.load_torque = -self._moment * torch.sin(signals.position)
        signals.radial_force = (self._mass * GRAVITY).expand_as(zeros)
        default_commands(signals, self.model)
        set_commands(signals, commands or {})
        set_start(signals, load_torque, current, time)
        self._steps = 0
        self._translated = None
        self.failed = torch.zeros(self.num_sims, dtype=torch.bool)
        self.law.reset(signals)

    def command(self, **commands: Any) -> None:
        """Set commands for the steps to come; those not named are held."""
        set_commands(self.signals, commands)

    @property
    def translated(self) -> bool:
        """Whether numpy has taken over."""
        return self._translated is not None

    def advance(self) -> None:
        """One step."""
        if self._translated is not None:
            self._translated.advance(self.signals)
            return
        if self._steps % self._every == 0:
            self.law.tick(self.signals)
        self._move(self.signals)
        self._steps += 1
        if self._translate and self._steps % TRANSLATED_AFTER == 0 and not self._differentiated:
            self._translated = Translated.of(self._tick_and_move, self.signals, REPORTED)
            self._translate = self._translated is not None

    @property
    def _differentiated(self) -> bool:
        """Whether anything is to be differentiated, which numpy could not."""
        known = (*self.parameters.values(), *vars(self.signals).values(), self._mass, self._length)
        return any(isinstance(value, Tensor) and value.requires_grad for value in known)

    def _tick_and_move(self, signals: Signals) -> None:
        self.law.tick(signals)
        self._move(signals)

    def _move(self, signals: Signals) -> None:
        """Apply the law and integrate one step."""
        step = self.timestep
        self.law.step(signals)
        gravity = -self._moment * torch.sin(signals.position)
        inertia = self._total + step * signals.damping
        free = signals.velocity + step * (signals.applied_torque + gravity) / inertia
        # friction takes up to its impulse from the speed and no more
        speed = (free.abs() - step * signals.friction_bound / inertia).clamp(min=0.0)
        velocity = torch.copysign(speed, free)
        # what the output transmits moves the link against gravity; the load on the servo is its reaction
        acceleration = (velocity - signals.velocity) / step
        signals.load_torque = gravity - self._inertia * acceleration
        if self._reads_force:
            signals.radial_force = self._force(signals, acceleration)
        signals.velocity = velocity
        signals.position = signals.position + step * velocity

    def _force(self, signals: Signals, acceleration: Tensor) -> Tensor:
        """What the shaft bears [N]: the weight's acceleration along the arm and across it, less gravity's."""
        along = GRAVITY * torch.cos(signals.position) + self._length * signals.velocity.square()
        across = GRAVITY * torch.sin(signals.position) + self._length * acceleration
        return self._mass * torch.hypot(along, across)

    def measure(self) -> dict[tuple[str, str], Tensor]:
        """What the servo's sensors say now: channels of the log, ``[sim, 1]``."""
        self.law.sense(self.signals)
        self.law.report(self.signals)
        signals = self.signals
        self.failed |= ~(torch.isfinite(signals.position) & (signals.position.abs() < 1e3))[:, 0]
        return {
            ("joint", "position"): signals.measured_position.clone(),
            ("joint", "velocity"): signals.measured_velocity.clone(),
            ("joint", "current"): signals.measured_current.clone(),
            ("joint", "duty"): signals.duty * signals.torque_enable,
        }
