"""The servo law of one robot model: its effects in the order of their stages, one simulation step at a time."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from op3.servo.effect import Clock, Effect, Prepared, Signals, Stage, Trunk, in_stage_order


class ServoLaw:
    """Runs the effects of a model over ``[sim, joint]``.

    The caller fills the inputs of the signals, calls ``tick`` once per control period and ``step`` once per
    simulation step, and hands ``applied_torque``, ``damping`` and ``friction_bound`` to the physics.

    Args:
        effects: what is on; their order does not matter.
        timestep: simulation step [s].
        period: time between ticks [s].
        joints: names of the joints; ``l_`` and ``r_`` begin those of the left and the right side.

    Raises:
        ValueError: if an effect is listed twice.
    """

    def __init__(self, effects: Sequence[Effect], timestep: float, period: float, joints: Sequence[str] = ()):
        self.effects = in_stage_order(effects)
        self.clock = Clock(timestep, period)
        self._sides = torch.tensor([_side(name) for name in joints] or [0.0], dtype=torch.float64)
        self._ticking = [e for e in self.effects if type(e).tick is not Effect.tick]
        self._beginning = [e for e in self.effects if type(e).begin is not Effect.begin]
        self._finishing = [e for e in self.effects if type(e).finish is not Effect.finish]
        self._on_motor_side = [e for e in self.effects if type(e).motor_side is not Effect.motor_side]
        self._reporting = [e for e in self.effects if type(e).report is not Effect.report]
        self._on_trunk = [e for e in self.effects if type(e).sense_trunk is not Effect.sense_trunk]
        acting = [e for e in self.effects if type(e).apply is not Effect.apply]
        self._sensing = [e for e in acting if e.stage == Stage.SENSING]
        self._acting = [e for e in acting if e.stage != Stage.SENSING]
        self._prepared: dict[str, Prepared] = {}
        self._reads_fade = self.reads("fade")
        self._reads_time = self.reads("time")

    def reads(self, signal: str) -> bool:
        """Whether an effect reads this signal, so that the simulation must fill it."""
        return any(signal in effect.reads for effect in self.effects)

    def set_parameters(self, values: Mapping[str, Tensor]) -> None:
        """Take parameter values, each broadcastable to ``[sim, joint]``, by name.

        Raises:
            ValueError: if a value is missing.
        """
        for effect in self.effects:
            values = effect.adjust(values, self._sides)
        for effect in self.effects:
            missing = [p.name for p in effect.parameters if p.name not in values]
            if missing:
                raise ValueError(f"effect {effect.name!r} needs values for {', '.join(missing)}")
            own = {p.name: values[p.name] for p in effect.parameters}
            own |= {name: values[name] for name in effect.borrows if name in values}
            self._prepared[effect.name] = effect.prepare(own, self.clock)

    def prepared(self) -> dict[tuple[str, str], Tensor]:
        """What was made of the parameters, by effect and name."""
        return {(effect, name): value for effect, own in self._prepared.items() for name, value in own.items()}

    def reset(self, signals: Signals) -> None:
        """Start from the joint state and commands in the signals, as if they had been held for long."""
        signals.state.clear()
        signals.factors.clear()
        self.sense(signals)
        signals.goal = signals.position_target
        for effect in self._ticking:
            if effect.stage == Stage.COMMAND:
                effect.tick(signals, self._prepared[effect.name])
        for effect in self.effects:
            effect.reset(signals, self._prepared[effect.name])

    def balance(self, signals: Signals, torque: Tensor, rests: Tensor) -> None:
        """Bend elastic elements, from the link to the motor, so that joints do what was measured.

        Args:
            signals: after a step.
            torque: by which that step's torque exceeds what the measured motion asks for [N m], ``[sim, joint]``.
            rests: where joints rest.
        """
        for effect in reversed(self.effects):
            torque = effect.balance(signals, self._prepared[effect.name], torque, rests)

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
        self.act(signals)

    def act(self, signals: Signals) -> None:
        """A simulation step whose sensors were read."""
        # effects may put other values in their place for the rest of the step
        position, velocity, load_torque = signals.position, signals.velocity, signals.load_torque
        bus_voltage, target_current = signals.bus_voltage, signals.target_current
        for effect in self._beginning:
            effect.begin(signals, self._prepared[effect.name])
        signals.speed = signals.velocity.abs()
        signals.friction_bound = torch.zeros_like(signals.speed)
        if self._reads_fade:
            signals.fade = torch.ones_like(signals.speed)
        for effect in self._acting:
            effect.apply(signals, self._prepared[effect.name])
        signals.position, signals.velocity, signals.load_torque = position, velocity, load_torque
        signals.bus_voltage, signals.target_current = bus_voltage, target_current
        for effect in self._finishing:
            effect.finish(signals, self._prepared[effect.name])
        if self._reads_time:
            signals.time = signals.time + self.clock.timestep
        signals.phase = signals.phase + 1

    def sense(self, signals: Signals) -> None:
        """Fill in what the servo's sensors say of the joint state in the signals."""
        signals.measured_position = signals.position
        signals.measured_velocity = signals.velocity
        for effect in self._sensing:
            effect.apply(signals, self._prepared[effect.name])

    def report(self, signals: Signals) -> None:
        """Fill in what the servo says of itself in a log."""
        signals.measured_current, velocity = signals.current, signals.velocity
        for effect in self._on_motor_side:
            effect.motor_side(signals, self._prepared[effect.name])
        for effect in self._reporting:
            effect.report(signals, self._prepared[effect.name])
        signals.velocity = velocity

    def sense_trunk(self, trunk: Trunk) -> Trunk:
        """What the trunk's IMU says of the true orientation and rates, which are left as they are."""
        seen = Trunk(trunk.quaternion, trunk.angular_velocity)
        for effect in self._on_trunk:
            effect.sense_trunk(seen, self._prepared[effect.name])
        return seen


def _side(joint: str) -> float:
    """+1 for a joint of the left side, -1 for one of the right, 0 for one in the middle."""
    return {"l_": 1.0, "r_": -1.0}.get(joint[:2], 0.0)
