"""The servo law of one robot model: its effects in the order of their stages, one simulation step at a time."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from op3.servo.effect import Clock, Effect, Prepared, Signals, Stage, in_stage_order


class ServoLaw:
    """Runs the effects of a model over ``[sim, joint]``.

    The caller fills the inputs of the signals, calls ``tick`` once per control period and ``step`` once per
    simulation step, and hands ``applied_torque``, ``damping`` and ``friction_bound`` to the physics.

    Args:
        effects: what is on; their order does not matter.
        timestep: simulation step [s].
        period: time between ticks [s].

    Raises:
        ValueError: if an effect is listed twice.
    """

    def __init__(self, effects: Sequence[Effect], timestep: float, period: float):
        self.effects = in_stage_order(effects)
        self.clock = Clock(timestep, period)
        self._ticking = [e for e in self.effects if type(e).tick is not Effect.tick]
        acting = [e for e in self.effects if type(e).apply is not Effect.apply]
        self._sensing = [e for e in acting if e.stage == Stage.SENSING]
        self._acting = [e for e in acting if e.stage != Stage.SENSING]
        self._prepared: dict[str, Prepared] = {}
        self._reads_fade = self.reads("fade")

    def reads(self, signal: str) -> bool:
        """Whether an effect reads this signal, so that the simulation must fill it."""
        return any(signal in effect.reads for effect in self.effects)

    def set_parameters(self, values: Mapping[str, Tensor]) -> None:
        """Take parameter values, each broadcastable to ``[sim, joint]``, by name.

        Raises:
            ValueError: if a value is missing.
        """
        for effect in self.effects:
            missing = [p.name for p in effect.parameters if p.name not in values]
            if missing:
                raise ValueError(f"effect {effect.name!r} needs values for {', '.join(missing)}")
            own = {p.name: values[p.name] for p in effect.parameters}
            self._prepared[effect.name] = effect.prepare(own, self.clock)

    def reset(self, signals: Signals) -> None:
        """Start from the joint state and commands in the signals, as if they had been held for long."""
        signals.state.clear()
        self.sense(signals)
        signals.goal = signals.position_target
        for effect in self._ticking:
            if effect.stage == Stage.COMMAND:
                effect.tick(signals, self._prepared[effect.name])
        for effect in self.effects:
            effect.reset(signals, self._prepared[effect.name])

    def tick(self, signals: Signals, readings: tuple[Tensor, Tensor] | None = None) -> None:
        """A control period begins: read the sensors, compute and send commands.

        Args:
            signals: with the joint state and the commands.
            readings: what the controller reads instead of what its sensors say: positions [rad] and velocities
                [rad/s] of a log, so that the commands are those that were sent.
        """
        signals.phase = 0
        self.sense(signals)
        if readings is not None:
            signals.measured_position, signals.measured_velocity = readings
        signals.goal = signals.position_target
        for effect in self._ticking:
            effect.tick(signals, self._prepared[effect.name])

    def step(self, signals: Signals) -> None:
        """One simulation step, from the joint state to torque, damping and friction bound."""
        if signals.phase > 0:
            self.sense(signals)
        signals.speed = signals.velocity.abs()
        signals.friction_bound = torch.zeros_like(signals.speed)
        if self._reads_fade:
            signals.fade = torch.ones_like(signals.speed)
        for effect in self._acting:
            effect.apply(signals, self._prepared[effect.name])
        signals.phase += 1

    def sense(self, signals: Signals) -> None:
        """Fill in what the servo's sensors say of the joint state in the signals."""
        signals.measured_position = signals.position
        signals.measured_velocity = signals.velocity
        for effect in self._sensing:
            effect.apply(signals, self._prepared[effect.name])
