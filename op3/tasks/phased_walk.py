"""A walk without learning in the actions of the walking task: feet led over the phase, and feedback of the tilt.

It is a function of what a policy sees, so that it can show a learner what walking is. The feet move as Cartesian
trajectories over the phase that the reward prescribes, in the legs' inverse kinematics; the trunk's tilt and rates turn
hips and ankles on top. Its numbers are found by search (`experiments/find_gait.py`).
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

from op3.policy import ActionMap
from op3.policy.observation import WALK_LAYOUT, layout_slices
from op3.robot.walking import leg_angles
from op3.tasks.rewards import FOOT_OFFSETS

Array = NDArray[np.float64]

_LONGEST = 0.2185
"""Longest leg that is asked for [m]; stretched it measures 0.22015 m, where the knee has no say."""


@dataclasses.dataclass(frozen=True)
class Stride:
    """Numbers of the walk; each a float, or an array [sim] with one value per robot.

    Lengths in m, angles in rad, phases and durations in cycles. A foot's own phase is 0 where its swing is due.

    Attributes:
        step: half of a foot's way against the body.
        lift: height of a swinging foot.
        swing_start: own phase at which a foot is lifted.
        swing_share: duration of the swing.
        crouch: by how much the stretched legs are shortened.
        forward: place of the feet ahead of the hips.
        sideways: place of the feet outside the hips.
        lean: forward lean of the trunk.
        sway: sideways sway of the body towards the standing foot.
        sway_phase: phase of the sway.
        sway_third: third harmonic of the sway, as a share of it; it holds the body over the foot for longer.
        surge: forward sway of the body, twice per cycle.
        surge_phase: its phase.
        bob: sway up and down, twice per cycle.
        bob_phase: its phase.
        hip_roll: turn of the stance leg's hip that raises the pelvis on the other side.
        stance_gain: P gain of a standing leg [A/rad].
        swing_gain: P gain of a swinging leg [A/rad].
        stance_hip_roll: feedback to hip roll while the foot stands, of roll and roll rate (s).
        swing_hip_roll: the same while it swings.
        stance_ankle_roll: feedback to ankle roll while the foot stands.
        stance_hip_pitch: feedback to hip pitch while the foot stands, of pitch and pitch rate.
        swing_hip_pitch: the same while it swings.
        stance_ankle_pitch: feedback to ankle pitch while the foot stands.
        *_rate: the same of the rates [s].
    """

    step: Any = 0.05
    lift: Any = 0.03
    swing_start: Any = 0.0
    swing_share: Any = 0.3
    crouch: Any = 0.025
    forward: Any = -0.01
    sideways: Any = 0.005
    lean: Any = 0.05
    sway: Any = 0.03
    sway_phase: Any = 0.0
    sway_third: Any = 0.0
    surge: Any = 0.0
    surge_phase: Any = 0.0
    bob: Any = 0.0
    bob_phase: Any = 0.0
    hip_roll: Any = 0.05
    stance_gain: Any = 6.0
    swing_gain: Any = 6.0
    stance_hip_roll: Any = 0.0
    stance_hip_roll_rate: Any = 0.0
    swing_hip_roll: Any = 0.0
    swing_hip_roll_rate: Any = 0.0
    stance_ankle_roll: Any = 0.0
    stance_ankle_roll_rate: Any = 0.0
    stance_hip_pitch: Any = 0.0
    stance_hip_pitch_rate: Any = 0.0
    swing_hip_pitch: Any = 0.0
    swing_hip_pitch_rate: Any = 0.0
    stance_ankle_pitch: Any = 0.0
    stance_ankle_pitch_rate: Any = 0.0

    @classmethod
    def load(cls, path: str | Path) -> "Stride":
        """Read numbers from YAML.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is no list of names and numbers, a name is unknown or a value is no finite number.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"{path}: no such file; give the numbers of a walk, such as assets/gaits/walk.yaml")
        known = [field.name for field in dataclasses.fields(cls)]
        try:
            values = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: not valid YAML ({' '.join(str(error).split())[:80]})") from None
        if not isinstance(values, dict):
            raise ValueError(f"{path}: must give numbers by name; the names are {', '.join(known)}")
        wrong = [name for name, value in values.items() if name not in known or not _finite(value)]
        if wrong:
            raise ValueError(f"{path}: {wrong[0]} must be one of {', '.join(known)}, each a number")
        return cls(**{name: float(value) for name, value in values.items()})

    def save(self, path: str | Path) -> None:
        """Write the numbers as YAML."""
        values = {name: round(float(value), 6) for name, value in vars(self).items()}
        Path(path).write_text(yaml.safe_dump(values, sort_keys=False), encoding="utf-8")


def _finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


class PhasedWalk:
    """Plays a `Stride` as a policy.

    Args:
        stride: numbers of the walk.
        action_map: what actions mean; targets beyond its range are clipped.
    """

    def __init__(self, stride: Stride, action_map: ActionMap):
        self.stride, self.action_map = stride, action_map
        # one number per robot must meet [sim, leg]
        self._numbers = {name: np.asarray(value, float)[..., None] for name, value in vars(stride).items()}

    def act(self, observation: Tensor) -> Tensor:
        """Actions ``[sim, action]`` for observations ``[sim, observation]`` of a walking task."""
        now = {name: observation[:, part].double().numpy() for name, part in layout_slices(WALK_LAYOUT).items()}
        phase = np.arctan2(now["phase"][:, 0], now["phase"][:, 1]) / (2 * np.pi)
        target, gain = self.commands(phase, now["orientation"], now["angular_velocity"])
        action = self.action_map.action(torch.from_numpy(target), torch.from_numpy(gain))
        return action.to(observation.dtype)

    def commands(self, phase: Array, orientation: Array, rates: Array) -> tuple[Array, Array]:
        """Target angles [rad] and gains [A/rad] of the controlled joints, ``[sim, joint]``.

        Args:
            phase: of the gait, ``[sim]`` in cycles.
            orientation: roll, pitch and yaw, ``[sim, 3]`` in rad.
            rates: of the body, ``[sim, 3]`` in rad/s.
        """
        n = self._numbers
        own = np.remainder(phase[:, None] + np.array(FOOT_OFFSETS) - n["swing_start"], 1.0)  # [sim, leg]
        share = n["swing_share"]
        swung = np.clip(own / share, 0.0, 1.0)
        swinging = np.sin(np.pi * swung) ** 2
        stood = np.clip((own - share) / (1.0 - share), 0.0, 1.0)
        forth = np.where(own < share, -np.cos(np.pi * swung), 1.0 - 2.0 * stood)
        # both legs in the left one's terms: to the right leg the body leans and sways the other way
        side = np.array([1.0, -1.0])
        cycle = 2 * np.pi * phase[:, None]
        swayed = np.sin(cycle - n["sway_phase"]) + n["sway_third"] * np.sin(3 * (cycle - n["sway_phase"]))
        ankle = np.stack(
            [
                n["forward"] + n["step"] * forth + n["surge"] * np.sin(2 * cycle - n["surge_phase"]),
                n["sideways"] + side * n["sway"] * swayed,
                n["crouch"] + n["lift"] * swinging + n["bob"] * np.sin(2 * cycle - n["bob_phase"]) - 0.22015,
            ],
            -1,
        )
        length = np.linalg.norm(ankle, axis=-1, keepdims=True)
        angles = leg_angles(ankle * np.minimum(1.0, _LONGEST / length), n["lean"])
        stance = 1.0 - swinging

        def feedback(name: str, axis: int, sign: Array) -> Array:
            return sign * (n[name] * orientation[:, axis, None] + n[f"{name}_rate"] * rates[:, axis, None])

        both = np.ones(2)
        angles["hip_roll"] = (
            angles["hip_roll"]
            + stance * (feedback("stance_hip_roll", 0, side) + n["hip_roll"] * swinging[:, ::-1])
            + swinging * feedback("swing_hip_roll", 0, side)
        )
        angles["ank_roll"] = angles["ank_roll"] + stance * feedback("stance_ankle_roll", 0, side)
        angles["hip_pitch"] = (
            angles["hip_pitch"]
            + stance * feedback("stance_hip_pitch", 1, both)
            + swinging * feedback("swing_hip_pitch", 1, both)
        )
        angles["ank_pitch"] = angles["ank_pitch"] + stance * feedback("stance_ankle_pitch", 1, both)
        legs = np.stack([angles[part] for part in _PARTS], -1) * side[:, None]  # [sim, leg, part]
        gain = n["stance_gain"] * stance + n["swing_gain"] * swinging
        return legs.reshape(len(phase), -1), np.repeat(gain, len(_PARTS), axis=-1)


_PARTS = ("hip_roll", "hip_pitch", "knee", "ank_pitch", "ank_roll")
"""Controlled joints of a leg, in the order of `CONTROLLED_JOINTS`."""
