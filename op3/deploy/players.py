"""Players record motions and policies on the real or the emulated robot with the same two methods."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from op3.deploy.connection import EMULATED, POLICY_RATE, Plan, connect, run
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.phases import FollowMotion
from op3.deploy.policy_runner import FollowPolicy, PolicyRunner
from op3.deploy.session import SessionOutcome
from op3.motions import Motion
from op3.policy import PolicyBundle
from op3.robot import Robot
from op3.rollout import Rollout
from op3.tasks.task import Task, find_task


class Player:
    """Plays motions and policies on a robot and returns their logs.

    Each recording is a separate run, from start checks to torque off; all its ticks are stored in a folder.

    Args:
        robot: a name in `assets/robots`, or the path of its file.
        folder: folder of the ticks of all runs.
        calibration: file with the joints' offsets; None: no offsets.
        confirm: whether a person must confirm before torque.
        seed: seed of an emulated robot; recording k adds k.
        report: receives lines for the operator; None: the terminal, above the live view.
        emulation: further options of `op3.deploy.emulated.emulate`.
    """

    def __init__(
        self,
        port: str = EMULATED,
        mount: str = "floor",
        *,
        folder: str | Path,
        robot: str | Robot,
        calibration: str | Path | None = None,
        confirm: bool = True,
        seed: int = 0,
        report: Callable[[str], None] | None = None,
        **emulation: Any,
    ):
        self._port, self._robot = port, robot
        self._common: dict[str, Any] = dict(robot=robot, mount=mount, confirm=confirm, calibration=calibration)
        self._folder = Path(folder)
        self._seed, self._emulation, self._report = seed, emulation, report
        self._count = 0

    def play(
        self, motion: Motion, p_gain: ArrayLike = 6.0, d_gain: ArrayLike = 0.1, *, recording: str | None = None
    ) -> Rollout:
        """Follow a motion and record it; see `FollowMotion` for the gains.

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

        A fall, or another stop while the policy runs, ends the episode without an exception: the log is marked as
        fallen, with the reason in ``extra["ended_by"]``.

        Args:
            cycle: duration of a gait cycle [s], for a policy that sees the phase.
            task: task of the episode and of an emulated robot's ground; None: the policy's task, on the floor.

        Raises:
            Stop: if the run ended before the policy began.
        """
        task = None if task is None else find_task(task)
        runner = PolicyRunner(bundle, cycle, robot=self._robot)
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
        """Count an existing recording, so that the next recording is the same as if this one had been recorded now."""
        self._count += 1

    def _record(self, make: Any, recording: str | None, ground: Task | None = None, **options: Any) -> Rollout:
        name = recording or f"recording-{self._count}"
        _set_aside(self._folder / name)
        plan = Plan(folder=self._folder / name)
        emulation: dict[str, Any] = {}
        if self._port == EMULATED:
            emulation = {**self._emulation, "seed": self._seed + self._count, "task": ground}
        with closing(connect(self._port, **self._common, **emulation)) as connection:
            outcome = run(connection, make, plan, recording=recording, report=self._report, **options)
        self._count += 1
        of_policy = "task" in options.get("extra", {})
        forgiven = POLICY_FAILED if of_policy else (ExitCode.FALL,)
        if outcome.code not in (ExitCode.OK, *forgiven):
            raise Stop(outcome.code, outcome.reason)
        if "run" not in outcome.logs:
            raise Stop(outcome.code, f"{outcome.reason}, before the recording {name} began")
        log = outcome.logs["run"]
        known: dict[str, Any] = {"recording": recording, "episode_duration": log.duration}
        if of_policy:
            known |= {"travelled_distance": connection.operator.travelled(), **_ending(outcome, log.metadata.extra)}
        return Rollout(log.data, log.metadata.replace(**known))


def _set_aside(ticks: Path) -> None:
    """Rename the folder of an interrupted run of this name."""
    if ticks.exists():
        number = len(list(ticks.parent.glob(f"{ticks.name}.unfinished-*")))
        ticks.rename(ticks.with_name(f"{ticks.name}.unfinished-{number}"))


POLICY_FAILED = (
    ExitCode.FALL,
    ExitCode.SERVO_SHUTDOWN,
    ExitCode.TEMPERATURE,
    ExitCode.VOLTAGE,
    ExitCode.NON_FINITE,
    ExitCode.SELF_COLLISION,
)
"""Exit codes that count as failures of the policy, unlike faults of the bus."""


def _ending(outcome: SessionOutcome, extra: dict[str, Any]) -> dict[str, Any]:
    """Metadata about the end of an episode."""
    if outcome.code == ExitCode.OK:
        return {}
    if outcome.ended_in == "run":
        return {"fallen": True, "extra": {**extra, "ended_by": outcome.reason}}
    return {"extra": {**extra, "afterwards": outcome.reason}}
