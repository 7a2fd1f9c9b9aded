"""Logs of several mounts: the stand is diagnosed, and its models are compared on logs of the robot on the floor."""

from collections.abc import Sequence
from typing import Any

from op3.diagnose.show import show
from op3.diagnose.split import LogSplit, repeats
from op3.rollout import LogError, Rollout
from op3.servo import RobotModel

BEGINNING = 5.0
"""Display: simulated duration of a log of another mount [s]; a robot on the floor soon diverges from its log."""

FIRST = ("stand", "pendulum", "floor")
"""Mounts in the order of preference: the stand shows most about servos."""


def diagnosed_mount(logs: Sequence[Rollout]) -> tuple[list[Rollout], dict[str, list[Rollout]]]:
    """The logs that are diagnosed, and the logs of other mounts, on which the gap is reported.

    Raises:
        LogError: if logs are of different robots, servos or joints, or of a bench and of a robot.
    """
    by_mount: dict[str, list[Rollout]] = {}
    for log in logs:
        by_mount.setdefault(log.metadata.mount, []).append(log)
    if "pendulum" in by_mount and len(by_mount) > 1:
        raise LogError(
            f"logs of a bench are mixed with logs of a robot ({', '.join(sorted(by_mount))})",
            "diagnose them separately",
            source=by_mount["pendulum"][0].metadata.recording,
            column="mount",
        )
    fields = {"robot_file": "robots", "robot": "kinds of robots", "servo": "servos"}
    for field, what in fields.items():
        of_robot = field == "robot_file"
        values = {log.robot.reference if of_robot else getattr(log.metadata, field): log for log in logs}
        values.pop(None, None)
        if len(values) > 1:
            raise LogError(
                f"the logs are of different {what} ({', '.join(sorted(values))})",
                "diagnose the logs of each separately",
                source=list(values.values())[-1].metadata.recording,
                column=field,
            )
    for log in logs:
        if log.joints != by_mount[log.metadata.mount][0].joints:
            raise LogError(
                f"its joints differ from those of {by_mount[log.metadata.mount][0].metadata.recording}",
                "diagnose logs of one set of joints at a time",
                source=log.metadata.recording,
                column="joints",
            )
    first = next((mount for mount in FIRST if mount in by_mount), next(iter(by_mount), ""))
    return by_mount.pop(first, []), by_mount


def on_other_mounts(
    before: RobotModel, after: RobotModel, others: dict[str, list[Rollout]], seed: int = 0
) -> dict[str, dict[str, Any]]:
    """Gap and loss of two models on the first `BEGINNING` seconds of logs to which neither was fitted, by mount.

    Returns:
        By mount the number of ``logs``, the ``seconds`` of the longest, and ``gap`` and ``loss`` as in a verdict.
    """
    result = {}
    for mount, logs in others.items():
        starts = [float(log.array("time")[0, 0]) for log in logs]
        parts = tuple(log.between(start, start + BEGINNING) for log, start in zip(logs, starts, strict=True))
        shown = show(before, after, LogSplit((), parts, repeats(parts)), seed=seed)
        longest = max(part.duration for part in parts)
        result[mount] = {"logs": len(parts), "seconds": longest, "gap": shown["gap"], "loss": shown["loss"]}
    return result
