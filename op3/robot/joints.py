"""The twenty joints of the OP3 as its file gives them: names, servo ids, axes, limits and mirror partners."""

from op3.robot.robot import load_robot

_OP3 = load_robot("op3")

JOINTS = _OP3.joints
"""The twenty joint names. Every array with a joint axis is in this order."""

SERVO_IDS = _OP3.bus_ids
"""Bus id of each joint's servo: odd on the right, even on the left."""

SOFT_LIMITS: dict[str, tuple[float, float]] = {
    name: (float(low), float(high)) for name, (low, high) in zip(JOINTS, _OP3.limits, strict=True)
}
"""Lowest and highest angle [rad] that software may command."""

CONTROLLED_JOINTS = _OP3.controlled
"""The ten leg joints without the hip yaws."""

HELD_JOINTS = _OP3.held
"""The other ten: head, arms and hip yaws."""

LIMBS = _OP3.limbs
"""Joints of the head, the arms and the legs, each limb from the trunk outwards."""

GEAR_RATIO = _OP3.servos[0].motor.gear_ratio.si
"""Reduction of the servos' gear train, motor turns per output turn."""

MIRROR = _OP3.mirror
"""For each joint, its left-right partner (itself for the head) and the sign the angle takes there."""

whole_limbs, indices, mirror = _OP3.whole_limbs, _OP3.indices, _OP3.mirrored
