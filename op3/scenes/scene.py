"""Scenes: the robot on a floor, the robot on a stand, one servo on a bench.

A scene is an editable MJCF tree: servos, sensors and weights are added to `joints` or `mjcf_model`; then `compile`
builds a MuJoCo model from the current tree.
"""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
from dm_control import composer, mjcf
from lxml import etree
from numpy.typing import ArrayLike, NDArray

from op3.common.assets import asset_path
from op3.common.settings import imported, nearest
from op3.robot.entity import RobotEntity
from op3.robot.kinematics import level_soles, quaternion, rotation_matrix, standing_height
from op3.robot.robot import Robot, checked_angles, exclude_neighbours, load_robot
from op3.scenes.board import AXIS_HEIGHT, TILT, TOP_HEIGHT
from op3.scenes.surfaces import add_bricks, add_tiles

SCENES: tuple[str, ...] = (
    "floor",
    "stand",
    "bench",
    "board",
    "board_weight",
    "bricks_a",
    "bricks_b",
    "bricks_c",
    "bricks_d",
    "terrain",
)
"""Names that `build_scene` knows."""


@dataclass(frozen=True, eq=False)
class Scene:
    """An editable scene that can be compiled.

    Attributes:
        arena: the composer arena.
        robot: the robot in the scene; None on the bench.
        joints: hinge elements [joint] in the robot's order; if limbs are omitted, only the remaining joints.
        name: one of `SCENES`, or the name of a user's scene.
        mount: mount in the logs: "stand", "pendulum" or the ground.
        tilt_roll: roll of a fixed base in rad.
        tilt_pitch: pitch of a fixed base in rad, positive forward.
        ground: full names of the geoms on which feet stand; empty on the bench.
        ground_height: height of the ground's origin in the world [m]; a board tilts about a point below it.
        ground_pitch: pitch of the ground at the start in rad.
    """

    arena: composer.Arena
    robot: RobotEntity | None
    joints: tuple[mjcf.Element, ...]
    name: str
    mount: str
    tilt_roll: float = 0.0
    tilt_pitch: float = 0.0
    ground: tuple[str, ...] = ("floor",)
    ground_height: float = 0.0
    ground_pitch: float = 0.0

    @property
    def mjcf_model(self) -> mjcf.RootElement:
        """The root of the MJCF tree."""
        return cast(mjcf.RootElement, self.arena.mjcf_model)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of `joints` in the compiled model, such as "arm/elbow"."""
        return tuple(str(joint.full_identifier) for joint in self.joints)

    @property
    def robot_file(self) -> Robot:
        """The robot of the scene; on the bench, the pendulum's robot."""
        return load_robot("bench") if self.robot is None else self.robot.robot

    @property
    def floating(self) -> bool:
        """Whether the trunk is free to move: qpos then starts with 7 and qvel with 6 numbers of the base."""
        return self.mount not in ("stand", "pendulum")

    @property
    def mounted_specific_force(self) -> NDArray[np.float64]:
        """Reading of an accelerometer on a fixed base [xyz] in m/s^2, in the base's frame.

        MuJoCo's accelerometer reads zero on a fixed body although a real one reads gravity, so logs on the stand use
        this value instead.
        """
        if self.floating:
            raise ValueError(f"the base of scene {self.name!r} moves: read the sensor imu_accelerometer instead")
        gravity = np.asarray(cast(Any, self.mjcf_model).option.gravity)
        return -rotation_matrix(self.tilt_roll, self.tilt_pitch).T @ gravity

    def foremost(self, data: mujoco.MjData) -> float:
        """Forward position of the foremost foot's inner tip in the world [m]; 0 without feet."""
        if self.robot is None or not self.robot_file.inner_tips:
            return 0.0
        points = self.robot.key_points
        return max(float(data.site(points[tip].full_identifier).xpos[0]) for tip in self.robot_file.inner_tips)

    def compile(self, visual: bool = True) -> mujoco.MjModel:
        """A MuJoCo model of the current tree. Every call recompiles.

        Args:
            visual: whether to include purely visual geoms. Without them the motion is identical and the
                simulation faster.
        """
        try:
            spec = mujoco.MjSpec.from_string(self.mjcf_model.to_xml_string(), assets=self.mjcf_model.get_assets())
            spec.compiler.discardvisual = not visual
            return exclude_neighbours(spec).compile()
        except ValueError as error:  # from a user's scene
            raise ValueError(f"scene={self.name}: {' '.join(str(error).splitlines()[:2])}") from None

    def initial_qpos(
        self, joint_position: ArrayLike, roll: float | None = None, pitch: float | None = None
    ) -> NDArray[np.float64]:
        """Full qpos of a pose; if the base is free, the lowest sole corner touches the ground.

        Args:
            joint_position: [joint] in rad, in the order of `joints`.
            roll: roll of a free trunk against the ground in rad; None: the soles lie flat.
            pitch: pitch of a free trunk against the ground in rad, positive forward; None: the soles lie flat.

        Returns:
            [qpos]: with a free base the trunk's x, y, z in m, its quaternion (w, x, y, z), the joints, and then other
            moving bodies; otherwise only the joints.
        """
        position = checked_angles(joint_position, len(self.joints))
        every = self.robot_file.configuration(position) if self.robot_file.unpowered else position
        if self.floating:
            level_roll, level_pitch = level_soles(position, self.robot_file)
            roll = level_roll if roll is None else roll
            pitch = level_pitch if pitch is None else pitch
            height = standing_height(position, self.robot_file, roll, pitch)
            return np.concatenate([*self._on_ground(height, roll, pitch), every, self._others()])
        if roll or pitch:
            raise ValueError(
                f"the base of scene {self.name!r} is fixed, so roll and pitch do not apply; "
                "tilt the stand with build_scene('stand', robot, tilt_roll=..., tilt_pitch=...)"
            )
        return every.copy()

    def _on_ground(self, height: float, roll: float, pitch: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position and quaternion of a trunk with this height above the ground and this tilt relative to it."""
        if not self.ground_pitch:
            return np.array([0.0, 0.0, self.ground_height + height]), quaternion(roll, pitch)
        turned = np.empty(4)
        mujoco.mju_mulQuat(turned, quaternion(0.0, self.ground_pitch), quaternion(roll, pitch))
        above = rotation_matrix(0.0, self.ground_pitch) @ [0.0, 0.0, TOP_HEIGHT + height]
        above[2] += self.ground_height - TOP_HEIGHT
        return above, turned

    def _others(self) -> NDArray[np.float64]:
        """Initial positions of moving bodies other than the robot."""
        if self.name == "board":
            return np.zeros(2)
        if self.name == "board_weight":
            return np.array([self.ground_pitch, 0.0])
        if self.name in SCENES:
            return np.zeros(0)
        return self.compile(visual=False).qpos0[7 + len(self.joints) :]


def build_scene(
    name: str,
    robot: str | Robot,
    *,
    tilt_roll: float = 0.0,
    tilt_pitch: float = 0.0,
    joints: Sequence[str] | None = None,
) -> Scene:
    """A new scene.

    Args:
        name: "floor": level floor, free robot. "stand": the base is fixed 0.5 m up, no foot reaches the
            ground. "bench": one servo with the default pendulum (see `build_bench`). "board": a board that
            `BoardDrive` tilts. "board_weight": a passive board between stops, and a weight that `WeightDrive` lowers
            on it. "bricks_a", "bricks_b", "bricks_c": 5 mm bricks ahead of the robot. "terrain": tiles ahead of the
            robot whose heights `place_tiles` sets. Or a scene of your own: the path of an MJCF file that is laid on
            the floor, or the dotted name of a function of a robot that returns such a `dm_control.mjcf.RootElement`, or
            a `Scene`. Bodies in it may have joints, but no free ones.
        robot: a robot, its name, or the path of its file; on the stand any, elsewhere one with soles.
        tilt_roll: roll of the stand in rad.
        tilt_pitch: pitch of the stand in rad, positive forward.
        joints: on the stand, limbs without any of these are omitted, because they do not affect the others with a fixed
            base. None: the whole robot.
    """
    known = load_robot(robot)
    check_scene(name, known)
    if name != "stand" and (tilt_roll or tilt_pitch):
        raise ValueError(f"only the scene 'stand' can be tilted, got tilt_roll and tilt_pitch for {name!r}")
    if name != "stand" and joints is not None:
        raise ValueError(f"only the scene 'stand' can omit limbs, got joints for {name!r}")
    if name == "bench":
        return build_bench()
    if name == "stand":
        arena, entity = composer.Arena(xml_path=str(asset_path("scenes/stand.xml"))), RobotEntity(known)
        kept = _without_limbs(entity, known.joints if joints is None or known.unpowered else joints)
        root: Any = arena.mjcf_model
        mount = root.find("site", "mount")
        mount.quat = quaternion(tilt_roll, tilt_pitch)
        arena.attach(entity, mount)
        return Scene(arena, entity, kept, name, name, tilt_roll, tilt_pitch)
    return _own_scene(name, known) if "." in name else _on_floor(name, known)


def check_scene(name: str, robot: Robot) -> None:
    """Raise an error for an unknown scene, or a scene in which the robot cannot stand."""
    if name not in SCENES and "." not in name:
        raise ValueError(f"unknown scene {name!r}{nearest(name, SCENES)}, or give an MJCF file or package.function")
    if name not in ("stand", "bench") and not robot.sole_geoms:
        raise ValueError(
            f"{robot.name} cannot stand: the scene {name!r} needs soles, but its file names neither soles nor"
            " colliding feet; add feet: [<body>, ...]; for an arm, choose task=reach or mount=stand"
        )


def _without_limbs(entity: RobotEntity, wanted: Sequence[str]) -> tuple[mjcf.Element, ...]:
    """Remove limbs without any wanted joint from a robot, and return the remaining joints."""
    robot, joints = entity.robot, dict(zip(entity.robot.joints, entity.joints, strict=True))
    kept = robot.whole_limbs(wanted)
    for limb in robot.limbs:
        if limb[0] not in kept:
            root: Any = joints[limb[0]].parent
            root.remove()
    return tuple(joints[name] for name in kept)


def _own_scene(name: str, robot: Robot) -> Scene:
    """A scene from a user's file or function."""
    if name.endswith(".xml"):
        if not Path(name).is_file():
            raise ValueError(f"scene={name}: there is no such file; correct the path")
        try:
            return _on_floor(name, robot, mjcf.from_path(name))
        except (ValueError, KeyError, AttributeError, etree.XMLSyntaxError) as error:
            raise ValueError(f"scene={name}: {error}") from None
    made = imported(name, "scene")(robot)
    if isinstance(made, Scene):
        return made
    if not isinstance(made, mjcf.RootElement):
        raise ValueError(f"scene={name}: the function must return an mjcf.RootElement or a Scene, got {made!r}")
    return _on_floor(name, robot, made)


def _on_floor(name: str, known: Robot, laid: Any = None) -> Scene:
    """The robot on the floor, and what is laid on it: of a user's own, or of the scene."""
    arena, robot = composer.Arena(xml_path=str(asset_path("scenes/floor.xml"))), RobotEntity(known)
    root: Any = arena.mjcf_model
    board = name.startswith("board")
    height = AXIS_HEIGHT + TOP_HEIGHT if board else 0.0
    # The model's reference pose stands on the ground, legs straight: tracking cameras measure from it.
    frame: Any = arena.add_free_entity(robot)
    frame.pos = [0.0, 0.0, height + standing_height(known.pose("zero"), known)]
    ground = ["floor"]
    own = laid is not None
    if not own and name != "floor":
        laid = mjcf.from_path(str(asset_path(f"scenes/{name if board else 'uneven'}.xml")))
        if name == "terrain":
            add_tiles(laid)
        elif not board:
            add_bricks(laid, name)
    if laid is not None:
        for number, geom in enumerate(laid.find_all("geom")):
            geom.name = geom.name or f"geom_{number}"
        # behind the robot, whose joints so stay the first
        root.attach(laid)
        ground += [str(geom.full_identifier) for geom in laid.find_all("geom") if own or _meets_feet(geom)]
    pitch = TILT if name == "board_weight" else 0.0
    return Scene(arena, robot, tuple(robot.joints), name, name, 0.0, 0.0, tuple(ground), height, pitch)


def _meets_feet(geom: Any) -> bool:
    kind = getattr(geom.dclass, "dclass", geom.dclass)
    return str(kind).rsplit("/", 1)[-1] == "ground"


def build_bench(mass: float | None = None, length: float | None = None) -> Scene:
    """One servo whose horizontal shaft carries a pendulum: a point mass on a massless arm.

    About the shaft the inertia is mass * length^2 and gravity's torque -mass * 9.81 * length * sin(position);
    position 0 hangs down.

    Args:
        mass: mass of the weight in kg; None: that of `assets/robots/bench.yaml`.
        length: distance of the weight from the shaft in m; None: the same.
    """
    bench = load_robot("bench")
    mass = bench.file.parameters["mass"].default if mass is None else mass
    length = bench.file.parameters["length"].default if length is None else length
    if not (mass > 0 and length > 0):
        raise ValueError(f"mass and length must be positive, got {mass} kg and {length} m")
    arena = composer.Arena(xml_path=str(asset_path("scenes/bench.xml")))
    entity = RobotEntity(bench, mass=mass, length=length)
    root: Any = arena.mjcf_model
    mount = root.find("site", "mount")
    mount.pos = [0.0, 0.0, max(0.4, length + 0.1)]
    # The looks follow: the weight is a brass disc of the right mass, 20 mm thick.
    radius = float(np.sqrt(mass / (8500.0 * np.pi * 0.02)))
    looks: Any = entity.mjcf_model
    looks.find("geom", "arm").fromto = [0.0, 0.0, 0.0, 0.0, 0.0, -length]
    looks.find("geom", "weight").fromto = [-0.01, 0.0, -length, 0.01, 0.0, -length]
    looks.find("geom", "weight").size = [radius]
    arena.attach(entity, mount)
    return Scene(arena, None, tuple(entity.joints), "bench", "pendulum", ground=())
