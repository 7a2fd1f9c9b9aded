"""Robots that record motions and policies: the real one and the emulated one, behind the same two verbs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from op3.deploy.deploy import EMULATED, POLICY_RATE, Connection, Plan, connect, run
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Limits
from op3.deploy.phases import FollowMotion
from op3.deploy.policy_runner import FollowPolicy, PolicyRunner
from op3.deploy.session import Outcome
from op3.policy import PolicyBundle
from op3.robot import DEFAULT, Motion, Robot
from op3.rollout import Rollout
from op3.tasks.task import Task, find_task


class Player:
    """Plays motions and policies on a robot and gives back their logs.

    Each recording is a run of its own, from start checks to torque off; all ticks of it are kept in a folder.

    Args:
        port: of the robot, or `emulated`.
        mount: `floor` or `stand`.
        robot: a name in `assets/robots`, or the path of its file.
        folder: where the ticks of all runs are kept.
        limits: what the robot may do.
        calibration: file with the joints' offsets; None for none.
        confirm: whether a person is asked before torque.
        end_pose: pose in which the robot is let go.
        seed: of an emulated robot; the k-th recording adds k.
        report: where lines for the operator go; None for the terminal, above the live view.
        emulation: further options of `op3.deploy.emulated.emulate`.
    """

    def __init__(
        self,
        port: str = EMULATED,
        mount: str = "floor",
        *,
        folder: str | Path,
        robot: str | Robot = DEFAULT,
        limits: Limits | None = None,
        calibration: str | Path | None = None,
        confirm: bool = True,
        end_pose: str | None = None,
        seed: int = 0,
        report: Callable[[str], None] | None = None,
        **emulation: Any,
    ):
        self._port, self._common = port, dict(robot=robot, mount=mount, confirm=confirm, calibration=calibration)
        self._folder, self._limits, self._end_pose = Path(folder), limits or Limits(), end_pose
        self._seed, self._emulation, self._report = seed, emulation, report
        self._count = 0

    def play(
        self, motion: Motion, p_gain: ArrayLike = 6.0, d_gain: ArrayLike = 0.1, *, recording: str | None = None
    ) -> Rollout:
        """Follow a motion and record it.

        Args:
            motion: targets; joints that it does not name stay at home.
            p_gain: one number, [joint], or [row, joint] with one row per tick of 8 ms [A/rad].
            d_gain: the same [A s/rad].
            recording: identity of the recording.

        Raises:
            Stop: if the run ended early; the ticks are kept.
        """
        phase = FollowMotion(motion, p_gain, d_gain)
        gains = {"p_gain": phase.p_gain[0], "d_gain": phase.d_gain[0]}
        return self._record(lambda: phase, recording, start=phase.targets[0], motion=motion.name, **gains)

    def run_policy(
        self,
        bundle: PolicyBundle,
        duration: float,
        *,
        cycle: float | None = None,
        task: str | Task | None = None,
        recording: str | None = None,
    ) -> Rollout:
        """Run one episode of a policy and record it.

        A fall, or another reason to stop the robot while the policy commands it, ends the episode and is no
        error: the log counts as fallen and says why in ``extra["ended_by"]``.

        Args:
            bundle: the policy.
            duration: of the episode [s].
            cycle: duration of a gait cycle [s], for a policy that sees the phase.
            task: of the episode, for the metadata; an emulated robot stands on the ground of this task. None: that of
                the policy, on the floor.
            recording: identity of the recording.

        Raises:
            Stop: if the policy did not come to command the robot.
        """
        task = None if task is None else find_task(task)
        runner = PolicyRunner(bundle, cycle)
        return self._record(
            lambda: FollowPolicy(runner, duration),
            recording,
            motion=bundle.manifest.task,
            policy_rate=POLICY_RATE,
            model_hash=bundle.manifest.training.model_hash or None,
            ground=task,
            extra={"task": bundle.manifest.task if task is None else task.name},
        )

    def skip(self) -> None:
        """Count a recording that exists already, so that the next is as it would have been after it."""
        self._count += 1

    def _record(self, make: Any, recording: str | None, ground: Task | None = None, **options: Any) -> Rollout:
        name = recording or f"recording-{self._count}"
        _set_aside(self._folder / name)
        plan = Plan(limits=self._limits, end_pose=self._end_pose, folder=self._folder / name)
        connection = self._connect(ground)
        try:
            outcome = run(connection, make, plan, recording=recording, report=self._report, **options)
        finally:
            connection.close()
        self._count += 1
        if "task" in options.get("extra", {}):
            return _episode(outcome, recording, connection.operator.travelled())
        if outcome.code not in (ExitCode.OK, ExitCode.FALL) or "run" not in outcome.logs:
            raise Stop(outcome.code, outcome.reason)
        log = outcome.logs["run"]
        return Rollout(log.data, log.metadata.replace(recording=recording, episode_duration=log.duration))

    def _connect(self, ground: Task | None = None) -> Connection:
        emulation: dict[str, Any] = {}
        if self._port == EMULATED:
            emulation = {**self._emulation, "seed": self._seed + self._count, "task": ground}
        return connect(self._port, **self._common, **emulation)


def _set_aside(ticks: Path) -> None:
    """Keep the ticks of a run of this name that was cut short, under another one."""
    if ticks.exists():
        number = len(list(ticks.parent.glob(f"{ticks.name}.unfinished-*")))
        ticks.rename(ticks.with_name(f"{ticks.name}.unfinished-{number}"))


POLICY_FAILED = (
    ExitCode.FALL,
    ExitCode.SERVO_SHUTDOWN,
    ExitCode.TEMPERATURE,
    ExitCode.VOLTAGE,
    ExitCode.NON_FINITE,
)
"""Ends of an episode that its policy has to answer for, unlike those of the bus."""


def _episode(outcome: Outcome, recording: str | None, travelled: float | None) -> Rollout:
    """The log of an episode, under the name that was asked for."""
    if outcome.code not in (ExitCode.OK, *POLICY_FAILED) or "run" not in outcome.logs:
        raise Stop(outcome.code, outcome.reason)
    log = outcome.logs["run"]
    known = {"recording": recording, "episode_duration": log.duration, "travelled_distance": travelled}
    if outcome.code != ExitCode.OK and outcome.ended_in == "run":
        known |= {"fallen": True, "extra": {**log.metadata.extra, "ended_by": outcome.reason}}
    elif outcome.code != ExitCode.OK:
        known |= {"extra": {**log.metadata.extra, "afterwards": outcome.reason}}
    return Rollout(log.data, log.metadata.replace(**known))
