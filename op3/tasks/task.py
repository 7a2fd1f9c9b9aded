"""The balancing and walking tasks as data: where, how long, what is rewarded, what the policy senses."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil, radians
from typing import Annotated, Any, Literal

from pydantic import Field

from op3.policy.manifest import Manifest
from op3.policy.observation import BALANCE_LAYOUT, WALK_LAYOUT
from op3.robot.surfaces import TILE_HEIGHT
from op3.settings import Listed, NotNegative, Number, Positive, Share, Whole, settings
from op3.tasks import rewards
from op3.tasks.rewards import Coefficients
from op3.tasks.setups import OP3_CONTROL_PERIOD

TICKS = 4
"""Ticks of the PD control per policy step: 125 Hz and 31.25 Hz (paper)."""

POLICY_PERIOD = TICKS * OP3_CONTROL_PERIOD
"""Time between policy steps [s]."""

EXTRA_TERMS = ("overload", "self_contact", "clearance")
"""Terms of the training reward that are not in the paper, each with a weight of its own in the task."""

BoardMotion = Literal["still", "waves", "tilts", "weight"]
"""What moves a board: nothing, random waves, steps between two tilts, or a weight that is lowered on it."""


@dataclass(frozen=True)
class Placement:
    """How far an episode's beginning scatters about the stand pose at rest; standard deviations, ours.

    Attributes:
        joint_position: of each leg joint [rad].
        joint_velocity: of each leg joint [rad/s].
        velocity: of the trunk, forwards and sideways [m/s].
        angular_velocity: of the trunk's roll and pitch [rad/s].
    """

    joint_position: float = 0.02
    joint_velocity: float = 0.1
    velocity: float = 0.02
    angular_velocity: float = 0.1


@settings("task")
class Task:
    """One task.

    Attributes:
        name: of the task.
        scene: name for `op3.robot.build_scene`.
        coefficients: of the training reward.
        desired_velocity: forwards and sideways [m/s].
        board: what moves the board; None where there is none.
        cycle: duration of a gait cycle [s]; None for a task without a gait.
        history: number of earlier observations that the policy sees besides the latest.
        duration: time limit of an episode [s].
        fall_angle: the episode ends when the trunk rolls or pitches further [rad].
        fall_height: the episode ends when the trunk's origin is lower than this above the ground [m]; it stands at
            0.24 m.
        terrain_height: highest tile of the scene "terrain" above the floor [m], up to 0.01.
        terrain_steps: probability that all tiles of an episode lie either on the floor or at the largest height.
        push: impulse at the trunk, in any of eight directions at a random time of the gait [N s].
        overload: weight, in the training reward and besides eq. (8), of currents that a servo cannot carry for long.
        self_contact: weight, in the training reward and besides eq. (8), of the share of a step in which the robot
            touches itself.
        clearance: weight, in the training reward and besides eq. (8), of swinging feet that are too low.
        clearance_height: height of a swinging foot's lowest key point above the other foot from which it is not [m].
        first_phase: of the gait when an episode begins [cycles]; None: drawn anew for every episode.
        whole_step: whether currents, motion of the body, forces and speeds of the feet enter the training reward as
            means over the policy step, or as they are at its end, where most of a landing escapes.
        placement: scatter of the beginning.
    """

    name: str
    scene: str
    coefficients: Coefficients
    desired_velocity: Annotated[Listed[Number], Field(min_length=2, max_length=2)] = (0.0, 0.0)
    board: BoardMotion | None = None
    cycle: Positive | None = None
    history: Whole = 1
    duration: Positive = 10.0
    fall_angle: Positive = radians(45.0)
    fall_height: NotNegative = 0.15
    terrain_height: Annotated[Number, Field(ge=0, le=TILE_HEIGHT)] = TILE_HEIGHT
    terrain_steps: Share = 0.0
    push: NotNegative = 0.0
    overload: NotNegative = 0.0
    self_contact: NotNegative = 0.0
    clearance: NotNegative = 0.0
    clearance_height: Positive = 0.02
    first_phase: Annotated[Number, Field(ge=0, lt=1)] | None = 0.0
    whole_step: bool = True
    placement: Placement = field(default_factory=Placement)

    def __post_init__(self):
        if (self.board == "weight") != (self.scene == "board_weight") or (self.board is None) != (
            not self.scene.startswith("board")
        ):
            raise ValueError(f"task {self.name!r}: scene {self.scene!r} cannot be moved by board={self.board!r}")

    @property
    def steps(self) -> int:
        """Policy steps of a full episode; 10 s are 313 steps of 32 ms."""
        return ceil(self.duration / POLICY_PERIOD - 1e-9)

    @property
    def layout(self) -> dict[str, int]:
        """Parts of one observation and their widths."""
        return BALANCE_LAYOUT if self.cycle is None else WALK_LAYOUT

    @property
    def reward_terms(self) -> tuple[str, ...]:
        """Names of the contributions to the training reward."""
        gait = () if self.cycle is None else ("bipedal", "speed_bonus")
        return ("command", "smooth", *gait, *(name for name in EXTRA_TERMS if getattr(self, name)))

    @property
    def observation_size(self) -> int:
        """Numbers that the policy sees, history included."""
        return sum(self.layout.values()) * (self.history + 1)

    def check_policy(self, manifest: Manifest, name: str) -> None:
        """Refuse a policy that cannot attempt the task; a ValueError that begins with its name."""
        try:
            manifest.check_fits(self.layout, self.history, 1 / OP3_CONTROL_PERIOD, 1 / POLICY_PERIOD)
        except ValueError as error:
            raise ValueError(f"{name} does not fit task {self.name}: {error}") from None


def _balance(name: str, board: BoardMotion) -> Task:
    return Task(name, "board_weight" if board == "weight" else "board", rewards.BALANCE, board=board)


def _walk(name: str, scene: str, push: float = 0.0) -> Task:
    return Task(name, scene, rewards.WALK, desired_velocity=(0.3, 0.0), cycle=1.0, history=3, push=push)


TASKS: Mapping[str, Task] = {
    task.name: task
    for task in (
        _balance("balance", "waves"),
        _balance("balance_eval", "tilts"),
        _balance("balance_weight", "weight"),
        _walk("walk", "floor"),
        _walk("walk_terrain", "terrain"),
        _walk("walk_bricks_a", "bricks_a"),
        _walk("walk_bricks_b", "bricks_b"),
        _walk("walk_bricks_c", "bricks_c"),
        _walk("walk_bricks_d", "bricks_d"),
        _walk("walk_push", "floor", push=1.0),
    )
}
"""The tasks that come with the project, by name."""


def find_task(task: str | Task, **changes: Any) -> Task:
    """A task by name, with some of its attributes changed.

    Raises:
        ValueError: if there is no such task.
    """
    if isinstance(task, str):
        if task not in TASKS:
            raise ValueError(f"unknown task {task!r}; the tasks are {', '.join(TASKS)}")
        task = TASKS[task]
    if not changes:
        return task
    unknown = sorted(set(changes) - set(vars(task)))
    if unknown:
        raise ValueError(f"a task has no {unknown[0]!r}; it has {', '.join(vars(task))}")
    return Task(**{**vars(task), **changes})
