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
from op3.deploy.state import Calibration
from op3.policy import PolicyBundle
from op3.robot import Motion
from op3.rollout import Rollout


class Player:
    """Plays motions and policies on a robot and gives back their logs.

    Each recording is a run of its own, from start checks to torque off; all ticks of it are kept in a folder.

    Args:
        port: of the robot, or `emulated`.
        mount: `floor` or `stand`.
        folder: where the ticks of all runs are kept.
        limits: what the robot may do.
        calibration: file with the joints' offsets; None for none.
        confirm: whether a person is asked before torque.
        end_pose: pose in which the robot is let go.
        seed: of an emulated robot; the k-th recording adds k.
        emulation: further options of `op3.deploy.emulated.emulate`.
    """

    def __init__(
        self,
        port: str = EMULATED,
        mount: str = "floor",
        *,
        folder: str | Path,
        limits: Limits | None = None,
        calibration: str | Path | None = None,
        confirm: bool = True,
        end_pose: str | None = None,
        seed: int = 0,
        report: Callable[[str], None] = print,
        **emulation: Any,
    ):
        self._port, self._mount, self._confirm = port, mount, confirm
        self._folder, self._limits, self._end_pose = Path(folder), limits or Limits(), end_pose
        self._calibration = None if calibration is None else Calibration.load(calibration)
        self._seed, self._emulation, self._report = seed, emulation, report
        self._count = 0

    def play(
        self, motion: Motion, p_gain: ArrayLike = 6.0, d_gain: ArrayLike = 0.1, *, recording: str | None = None
    ) -> Rollout:
        """Follow a motion and record it.

        Args:
            motion: targets; joints that it does not name stay in the pose "stand".
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
        task: str | None = None,
        recording: str | None = None,
    ) -> Rollout:
        """Run one episode of a policy and record it; a fall ends it, and is no error.

        Args:
            bundle: the policy.
            duration: of the episode [s].
            cycle: duration of a gait cycle [s], for a policy that sees the phase.
            task: of the episode, for the metadata; an emulated robot stands on the ground of this task. None: that of
                the policy, on the floor.
            recording: identity of the recording.

        Raises:
            Stop: if the run ended early for another reason.
        """
        runner = PolicyRunner(bundle, cycle)
        return self._record(
            lambda: FollowPolicy(runner, duration),
            recording,
            motion=bundle.manifest.task,
            policy_rate=POLICY_RATE,
            model_hash=bundle.manifest.training.model_hash or None,
            ground=task,
            extra={"task": task or bundle.manifest.task},
        )

    def _record(self, make: Any, recording: str | None, ground: str | None = None, **options: Any) -> Rollout:
        name = recording or f"recording-{self._count}"
        plan = Plan(limits=self._limits, end_pose=self._end_pose, folder=self._folder / name)
        connection = self._connect(ground)
        try:
            outcome = run(connection, make, plan, recording=recording, report=self._report, **options)
        finally:
            connection.bus.close()
        self._count += 1
        return _log(outcome, recording, connection.operator.travelled())

    def _connect(self, ground: str | None = None) -> Connection:
        emulation: dict[str, Any] = {}
        if self._port == EMULATED:
            emulation = {**self._emulation, "seed": self._seed + self._count, "task": ground}
        return connect(self._port, mount=self._mount, confirm=self._confirm, calibration=self._calibration, **emulation)


def _log(outcome: Outcome, recording: str | None, travelled: float | None) -> Rollout:
    """The log of the run itself, under the name that was asked for."""
    if outcome.code not in (ExitCode.OK, ExitCode.FALL) or "run" not in outcome.logs:
        raise Stop(outcome.code, outcome.reason)
    log = outcome.logs["run"]
    known = {"recording": recording, "episode_duration": log.duration, "travelled_distance": travelled}
    return Rollout(log.data, log.metadata.replace(**known))
