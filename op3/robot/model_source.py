"""The MJCF or URDF of a robot file as MuJoCo reads it: used, replaced and ignored elements.

For joints with a servo, the servo model replaces actuators, effort limits, damping, friction, armature, springs and
gravity compensation. Joints without a servo keep those of the model; coupled joints follow others by equalities.
Tendons, other equalities, sensors and keyframes are not used.
"""

# MuJoCo's types come from compiled modules without stubs, which the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import os
import re
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from op3.robot.robot_file import RobotFile, slide_of

USED, REPLACED, IGNORED = "used", "replaced by the servo model", "ignored"

_ROTOR = (0.1, 0.0025)
"""Radius [m] and mass [kg] of the invisible sphere that the servo of a slide turns: small compared with a geared
motor's inertia, but large enough for the equality, which is softer for a lighter hinge."""

_FIRM = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""Impedance of the equality that moves a slide, MuJoCo's largest: MuJoCo's default is soft, because the equality adds
the inverse inertias of hinge and slide regardless of the ratio [m/rad].
"""

_STIFF = (0.002, 1.0)
"""Time constant [s] and damping ratio of the equality that couples a joint."""

Followed = dict[str, tuple[str | None, float, float]]
"""By joint: the joint that it follows (None: it is held), ratio and offset."""


@dataclass(frozen=True)
class Part:
    """Elements of a model that act on joints.

    Attributes:
        what: kind of element.
        names: names of the joints or elements.
        fate: `USED`, `REPLACED` or `IGNORED`, with a reason.
    """

    what: str
    names: tuple[str, ...]
    fate: str

    @property
    def ignored(self) -> bool:
        """Whether op3 ignores it."""
        return self.fate.startswith(IGNORED)

    def __str__(self) -> str:
        shown = ", ".join(self.names[:6]) + (f" and {len(self.names) - 6} more" if len(self.names) > 6 else "")
        return f"{self.what} of {shown}: {self.fate}"


@dataclass(frozen=True, eq=False)
class ModelSource:
    """A model, ready to compile.

    Attributes:
        spec: the model without unused elements, free base and world.
        followed: joints that follow others or are held.
        parts: elements that act on joints, and their fate.
    """

    spec: mujoco.MjSpec
    followed: Followed
    parts: tuple[Part, ...]


def read_model(path: Path, content: RobotFile) -> ModelSource:
    """Read a robot's model.

    Raises:
        ValueError: if MuJoCo cannot read it, or a mesh of a ROS package is missing.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    spec.compiler.fusestatic = False  # otherwise a URDF's first link is merged into the world
    for mesh in spec.meshes:
        if "package:" in mesh.file:
            mesh.file = str(_of_package(mesh.file, path))
    _rename_joints(spec)
    slides = _drive_slides(spec, content)
    followed = _followed(spec, content, slides)
    parts = tuple(part for part in _parts(spec, content, followed) if part.names)
    around = spec.worldbody.geoms if content.base else ()
    for element in (*spec.actuators, *spec.sensors, *spec.keys, *spec.equalities, *spec.tendons, *around):
        spec.delete(element)
    for body in spec.bodies:
        body.gravcomp = 0.0
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
        elif joint.name in content.joints:
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.stiffness = np.zeros_like(joint.stiffness)
    for name, (driver, ratio, offset) in followed.items():
        data = np.zeros(mujoco.mjNEQDATA)
        data[:2] = offset, ratio
        names = {"name1": name} if driver is None else {"name1": name, "name2": driver}
        kinds: dict[str, Any] = {
            "type": mujoco.mjtEq.mjEQ_JOINT,
            "objtype": mujoco.mjtObj.mjOBJ_JOINT,
            "solref": _STIFF,
        }
        if driver in slides:
            kinds["solimp"] = _FIRM
        spec.add_equality(name=f"{name}_follows", data=data, active=True, **kinds, **names)
    return ModelSource(spec, followed, parts)


def _rename_joints(spec: mujoco.MjSpec) -> None:
    """Rename joints whose names cannot be log columns, because they contain blanks or begin with a digit."""
    for joint in spec.joints:
        name = re.sub(r"[^A-Za-z0-9_-]", "_", re.sub(r"^(?=[\d-])", "joint_", joint.name))
        if name == joint.name or spec.joint(name) is not None:
            continue
        for equality in spec.equalities:
            equality.name1, equality.name2 = (name if n == joint.name else n for n in (equality.name1, equality.name2))
        joint.name = name


def _drive_slides(spec: mujoco.MjSpec, content: RobotFile) -> dict[str, float]:
    """Add a hinge of the same name for each slide that a servo moves; the slide follows it by a ratio [m/rad]."""
    travels = {name: entry.travel for name, entry in content.joints.items() if entry.travel}
    slides = [one for one in spec.joints if one.name in travels and one.type == mujoco.mjtJoint.mjJNT_SLIDE]
    for slide in slides:
        name = slide.name
        slide.name = slide_of(name)
        rotor = slide.parent.parent.add_body(name=f"{name}_servo")
        shape = {"size": [_ROTOR[0], 0, 0], "mass": _ROTOR[1], "rgba": [0, 0, 0, 0], "contype": 0, "conaffinity": 0}
        rotor.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, **shape)
        ends = sorted(np.array(slide.range) / travels[name])
        rotor.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, limited=slide.limited, range=ends)
    return {name: travels[name] for name in travels if spec.joint(slide_of(name)) is not None}


def _followed(spec: mujoco.MjSpec, content: RobotFile, slides: Mapping[str, float]) -> Followed:
    """Couplings of joints without a servo, from the file or otherwise from the model; a joint on a slide follows its
    servo."""
    names = {joint.name for joint in spec.joints}  # the file's check rejects other names
    found: Followed = {
        name: (drive.joint, drive.ratio, drive.offset) if (drive := entry.coupled) else (None, 0.0, entry.held or 0.0)
        for name, entry in content.unpowered.items()
        if name in names and not entry.passive and (not entry.coupled or entry.coupled.joint in content.joints)
    }
    for name, coupling in _mimics(spec, content.joints).items():
        if name not in content.joints and name not in content.unpowered and coupling[0] in content.joints:
            found[name] = coupling
    for name, (driver, ratio, offset) in found.items():
        found[name] = (driver, ratio * slides.get(driver or "", 1.0), offset)
    return found | {slide_of(name): (name, travel, 0.0) for name, travel in slides.items()}


def _mimics(spec: mujoco.MjSpec, powered: Container[str]) -> dict[str, tuple[str, float, float]]:
    """Couplings from equalities of two joints in an MJCF, to which MuJoCo also converts a URDF's `mimic`.

    The joint with a servo drives the other.
    """
    found = {}
    for one in spec.equalities:
        if one.type == mujoco.mjtEq.mjEQ_JOINT and one.name2 and not np.any(one.data[2:5]):
            offset, ratio = (float(x) for x in one.data[:2])
            if one.name1 in powered and one.name2 not in powered and ratio:
                found[one.name2] = one.name1, 1 / ratio, -offset / ratio
            else:
                found[one.name1] = one.name2, ratio, offset
    return found


def _parts(spec: mujoco.MjSpec, content: RobotFile, followed: Followed) -> Iterator[Part]:
    joints = [joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    driven = [joint for joint in joints if joint.name in content.joints]
    free = tuple(joint.name for joint in joints if joint.name not in content.joints and joint.name not in followed)
    yield Part("actuators", tuple(one.name or one.target for one in spec.actuators), REPLACED)
    for what, acts in (
        ("damping", lambda joint: np.any(joint.damping)),
        ("friction", lambda joint: joint.frictionloss),
        ("armature", lambda joint: joint.armature),
        ("effort limits", lambda joint: np.any(joint.actfrcrange)),
    ):
        yield Part(what, tuple(joint.name for joint in driven if acts(joint)), REPLACED)
    yield Part("springs", tuple(joint.name for joint in driven if np.any(joint.stiffness)), IGNORED)
    yield Part("compensation of gravity", tuple(body.name for body in spec.bodies if body.gravcomp), IGNORED)
    yield Part("tendons", tuple(tendon.name or "one without a name" for tendon in spec.tendons), IGNORED)
    ignored = {name: coupling[0] for name, coupling in _mimics(spec, content.joints).items() if name in content.joints}
    couplings = tuple(f"{name} to {driver}" for name, driver in ignored.items())
    yield Part("coupling", couplings, f"{IGNORED}: the joint has its own servo")
    coupled = {*ignored, *(name for name, (driver, *_) in followed.items() if driver)}  # reported by couplings
    others = (e for e in spec.equalities if e.type != mujoco.mjtEq.mjEQ_JOINT or coupled.isdisjoint((e.name1, e.name2)))
    yield Part("equalities", tuple(e.name or " and ".join(filter(None, (e.name1, e.name2))) for e in others), IGNORED)
    yield Part("coupling", tuple(f"{n} to {driver}" for n, (driver, *_) in followed.items() if driver), USED)
    yield Part("held position", tuple(name for name, (driver, *_) in followed.items() if not driver), USED)
    yield Part("spring, damping and friction", free, f"{USED}, as passive joints")


def _of_package(file: str, model: Path) -> Path:
    """A mesh of a ROS package, searched near the model's file."""
    package, _, rest = re.sub("^.*package:/+", "", file).partition("/")
    above = [model.parent, *model.parent.parents][:4]
    tried = [place / rest for place in above] + [place / package / rest for place in above]
    tried += [model.parent / folder / Path(rest).name for folder in ("", "meshes", "assets")]
    found = next((path for path in tried if os.path.isfile(path)), None)
    if found is None:
        raise ValueError(
            f"mesh package://{package}/{rest} was not found: put the folder {package!r} beside {model.name}, or write"
            " the mesh's path in that file"
        )
    return found
