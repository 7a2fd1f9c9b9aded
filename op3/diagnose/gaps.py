"""What is left of a joint, or of most, and what that says whatever the catalogue explains."""

from collections.abc import Sequence

import numpy as np

from op3.diagnose.evidence import Contender
from op3.diagnose.thresholds import CONCENTRATED, CONTACTS, LARGE_GAP, OUTSTANDING, ROOM, STANDING


def large_gap(left: np.ndarray | None) -> float:
    """What is left in most joints, in standard deviations of a reading, if that is too much for nothing; else 0."""
    usual = float(np.median(left)) if left is not None and left.size else 0.0
    return usual if usual > LARGE_GAP else 0.0


def but_contacts(left: np.ndarray | None, found: Sequence[Contender]) -> np.ndarray | None:
    """What is left in each joint; of one in which contacts were found, whose rattling stays, what is left in most."""
    at = [joint for one in found if one.effect in CONTACTS for joint in one.joints or ()]
    if left is None or not left.size or not at:
        return left
    result = left.copy()
    result[at] = np.median(left)
    return result


def leaves_a_joint(leaders: Sequence[Contender]) -> bool:
    """Whether what was found leaves more in one joint than in others; impacts in their own joint do.

    Args:
        leaders: of every round; what the last leaves counts.
    """
    left = leaders[-1].left
    if not left.size or left.max() <= max(ROOM, STANDING * float(np.median(left))):
        return False
    return not any(one.effect in CONTACTS and one.joints == (int(left.argmax()),) for one in leaders)


def stands_out(left: np.ndarray | None) -> int | None:
    """The joint in which something is missing whatever the catalogue says; None if there is none."""
    if left is None or not left.size or left.max() <= max(LARGE_GAP, OUTSTANDING * float(np.median(left))):
        return None
    return int(left.argmax())


def unresolved(named: Sequence[Contender]) -> bool:
    """Whether what several rounds have named leaves a gap as large as `LARGE_GAP`; of impacts in its joint it may.

    That the joint stands out no longer is not enough: names that are not the right ones bend all others as well.

    Args:
        named: the leader of every round; what the last leaves counts.
    """
    left = named[-1].left if named else np.zeros(0)
    if not left.size or left.max() <= LARGE_GAP:
        return False
    return not any(one.effect in CONTACTS and one.joints == (int(left.argmax()),) for one in named)


def contradicted(named: Sequence[Contender], joint: int | None) -> bool:
    """Whether the joint in which a later round finds something unknown is the one of a fault that was named.

    A hard stop was taken for friction by load, which explained half of it and left 37 times the noise. Impacts, whose
    rattling stays, are no such fault.

    Args:
        named: the leader of every round.
        joint: that stands out beside them, see `stands_out`; None if none does.
    """
    return joint is not None and any(one.joints == (joint,) and one.effect not in CONTACTS for one in named)


def closed(contender: Contender, left: np.ndarray, joint: int) -> float:
    """Share of a joint's gap, beyond what is usual in others, that a contender explains."""
    usual = float(np.median(left))
    return float((left[joint] ** 2 - contender.left[joint] ** 2) / (left[joint] ** 2 - usual**2))


def local_ceiling(gain: float, by_joint: np.ndarray) -> float | None:
    """What a black box explains in one joint; None where no joint stands out.

    Args:
        gain: of all joints' torques together.
        by_joint: of each alone, ``[joint]``.
    """
    largest = float(by_joint.max()) if by_joint.size else 0.0
    return largest if largest > 0 and largest >= CONCENTRATED * gain else None
