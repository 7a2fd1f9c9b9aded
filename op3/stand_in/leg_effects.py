"""Hidden effects that add friction or torque, each as a small function of a leg's state.

Forms differ from those of the project's catalogue wherever one can differ. A maker takes the hidden effect, the places
where it sits `[joint]` (1 or 0) and the names of the joints, and gives a function of the state: torques `[run, joint]`
in N m.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from op3.robot import LEG_JOINTS, indices, pose
from op3.stand_in.hidden import Hidden

Array = NDArray[np.float64]

REFERENCE_TEMPERATURE = 25.0
"""Temperature at which the world's numbers hold [C]."""

WARM_UP_TIME = 150.0
"""Time constant of friction that fades in the course of a day [s]."""


@dataclass(eq=False)
class LegState:
    """What the servos of all runs know of themselves.

    Attributes:
        timestep: of the physics [s].
        position: of the gear's motor side [run, joint] in rad.
        velocity: of the same [run, joint] in rad/s.
        link_position: of the joint [run, joint] in rad; differs where a gear is loose or soft.
        torque: of the motor, at the joint [run, joint] in N m.
        transmitted: torque that the gear passed on in the last step [run, joint] in N m.
        temperature: of the windings [run, joint] in C.
        time: since the run began, settling included [s].
        day_time: since the first run of the day [run, 1] in s.
    """

    timestep: float
    position: Array
    velocity: Array
    link_position: Array
    torque: Array
    transmitted: Array
    temperature: Array
    time: float
    day_time: Array


Term = Callable[[LegState], Array]
Maker = Callable[[Hidden, Array, Sequence[str]], Term]


def _load_friction(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """Friction per torque in the gear: from the torques on both its sides, or twice that on the motor's."""
    share = hidden.size * where
    if hidden.form == "motor":
        return lambda s: 2 * share * np.abs(s.torque)
    return lambda s: share * (np.abs(s.torque) + np.abs(s.transmitted))


def _position_friction(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """Friction of an oval seat, highest at two angles of a turn, or growing along the way."""
    centre = _centre(hidden, joints)
    if hidden.form == "ramp":
        return lambda s: where * hidden.size * np.clip(0.5 + (s.position - centre) / 1.2, 0, 1)
    return lambda s: where * hidden.size * np.cos(s.position - centre - 0.3 * np.pi) ** 2


def _asymmetric_friction(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """Friction that differs with the direction: half more one way, half less the other, blended at 10 mrad/s."""
    half = 0.5 * hidden.size * where
    return lambda s: half * np.tanh(s.velocity / 0.01)


def _sticky_patch(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """Friction within a narrow range of angles."""
    centre = _centre(hidden, joints)
    return lambda s: where * hidden.size * np.exp(-(((s.position - centre) / 0.03) ** 2))


FRICTION: dict[str, Maker] = {
    "load_friction": _load_friction,
    "position_friction": _position_friction,
    "asymmetric_friction": _asymmetric_friction,
    "sticky_patch": _sticky_patch,
}
"""Effects that raise the bound of friction, by name."""


def _quadratic_drag(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """Drag of grease, with the square of speed."""
    return lambda s: -hidden.size * where * s.velocity * np.abs(s.velocity)


def _cogging(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """Torque ripple over the angle, with 12 to 40 periods a turn."""
    periods, phase = round(12 + 28 * hidden.shape[0]), 2 * np.pi * hidden.shape[1]

    def ripple(s: LegState) -> Array:
        wave = np.sin(periods * s.position + phase)
        if hidden.form == "rounded_square":
            wave = np.tanh(2 * wave) / np.tanh(2)
        return hidden.size * where * wave

    return ripple


def _chipped_tooth(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """A share of the motor's torque that is lost while one damaged tooth is in mesh, every 0.35 rad."""
    phase = hidden.shape[0]

    def lost(s: LegState) -> Array:
        turn = (s.position / 0.35 + phase) % 1.0 - 0.5
        return -hidden.size * where * np.exp(-((turn / 0.06) ** 2)) * s.torque

    return lost


MOTOR_SIDE: dict[str, Maker] = {
    "quadratic_drag": _quadratic_drag,
    "cogging": _cogging,
    "chipped_tooth": _chipped_tooth,
}
"""Effects that put a torque on the motor's side of the gear, by name."""


def _cable_spring(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """A cable that pulls back to one angle; its hysteretic form rubs against itself."""
    stiffness, rest = hidden.size * where, _centre(hidden, joints)
    if hidden.form == "linear":
        return lambda s: -stiffness * (s.link_position - rest)
    rubbing: list[Array] = []

    def pull(s: LegState) -> Array:
        if not rubbing:
            rubbing.append(s.link_position.copy())
        # the slack end follows the joint at a distance of 0.05 rad: a play operator
        np.clip(rubbing[0], s.link_position - 0.05, s.link_position + 0.05, out=rubbing[0])
        return -stiffness * (rubbing[0] - rest)

    return pull


def _vibration(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """A torque of 7 to 15 Hz, whatever the joint does."""
    frequency, phase = 7 + 8 * hidden.shape[0], 2 * np.pi * hidden.shape[1]
    return lambda s: (
        hidden.size * where * np.sin(2 * np.pi * frequency * (s.time + s.day_time) + phase + 0.0 * s.position)
    )


def _hard_stop(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """A stiff obstacle beyond one angle, on the side away from the pose in which the leg rests."""
    side = 1.0 if hidden.shape[1] < 0.5 else -1.0
    edge = _stand(joints) + side * (0.12 + 0.12 * hidden.shape[0])
    return lambda s: -hidden.size * where * side * np.maximum(side * (s.link_position - edge), 0.0)


def _creep(hidden: Hidden, where: Array, joints: Sequence[str]) -> Term:
    """A spring whose rest angle follows the joint within a second or two (Maxwell)."""
    rate = 1 / (0.8 + 1.5 * hidden.shape[0])
    rest: list[Array] = []

    def pull(s: LegState) -> Array:
        if not rest:
            rest.append(s.link_position.copy())
        rest[0] += s.timestep * rate * (s.link_position - rest[0])
        return -hidden.size * where * (s.link_position - rest[0])

    return pull


LINK_SIDE: dict[str, Maker] = {
    "cable_spring": _cable_spring,
    "vibration": _vibration,
    "hard_stop": _hard_stop,
    "creep": _creep,
}
"""Effects that put a torque on the joint itself, by name."""


def _stand(joints: Sequence[str]) -> Array:
    return pose("stand")[indices(joints)]


def _centre(hidden: Hidden, joints: Sequence[str]) -> Array:
    """An angle within 0.12 rad of the pose about which the leg moves [joint] in rad."""
    return _stand(joints) + 0.24 * (hidden.shape[0] - 0.5)


def places(hidden: Hidden, joints: Sequence[str] = LEG_JOINTS) -> Array:
    """1 where the effect sits, 0 elsewhere [joint]."""
    if not hidden.joints:
        return np.ones(len(joints))
    return np.array([float(joint in hidden.joints) for joint in joints])
