"""The training loop: collect, learn, evaluate, save."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv

from op3.common.settings import Count, Listed, Named, Number, Whole, settings
from op3.policy import Manifest
from op3.train.algorithm import Algorithm
from op3.train.checkpoint import load_checkpoint, save_checkpoint, stop_requested
from op3.train.greedy_episodes import Policy

CHECKPOINT = "checkpoint.pt"
POLICY = "policy"

Evaluate = Callable[[Policy], Mapping[str, float]]
"""Measures of a policy without exploration; ``score``, or otherwise ``return``, selects the best policy."""

Log = Callable[[Mapping[str, float], int], None]
"""Receives measures by name and the number of environment steps."""


@settings("train")
class TrainSettings:
    """Settings of a run; one step is one policy step of one environment.

    Attributes:
        steps: number of steps of the run.
        overlap: whether the algorithm learns while the next rollout is collected, on separate cores. The result is
            bitwise identical.
        evaluate_every: steps between evaluations.
        checkpoint_every: steps between checkpoints.
        log_every: steps between log entries and progress lines.
        seed: seed of all random numbers.
    """

    steps: Count = 300_000
    overlap: bool = True
    evaluate_every: Count = 20_000
    checkpoint_every: Count = 100_000
    log_every: Count = 5_000
    seed: Whole = 0


Schedule = Listed[Listed[Number]]
"""Pairs of step number and value, linearly interpolated and constant beyond the ends."""


@settings()
class Curriculum:
    """Parameters of a task that change over the steps of a run; evaluations do not use them.

    Attributes:
        curricula: schedules by the path of a number in the task, such as ``shaping.speed_bonus.weight``; ``timestep``
            is the physics step [s], which changes at checkpoints, where all episodes restart.
    """

    curricula: Named[Schedule] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        for path, pairs in self.curricula.items():
            if not pairs or any(len(pair) != 2 for pair in pairs) or list(pairs) != sorted(pairs):
                raise ValueError(f"curricula.{path} lists pairs of steps and value, with increasing steps, got {pairs}")

    def at(self, steps: int) -> dict[str, float]:
        """Values after a number of steps, by path."""
        return {path: float(np.interp(steps, *np.array(pairs).T)) for path, pairs in self.curricula.items()}


@dataclasses.dataclass
class Progress:
    """Progress of a run.

    Attributes:
        steps: environment steps taken.
        best: highest score of an evaluation.
        best_steps: number of steps at that evaluation.
        history: one entry per log entry and evaluation, with ``steps``.
        seconds: wall time of training [s], evaluations included, over all resumptions.
        stopped: whether a signal ended the run early.
    """

    steps: int = 0
    best: float = float("-inf")
    best_steps: int = 0
    history: list[dict[str, float]] = dataclasses.field(default_factory=list)
    seconds: float = 0.0
    stopped: bool = False


def train(
    algorithm: Algorithm,
    environment: EnvBase,
    evaluate: Evaluate,
    settings: TrainSettings,
    manifest: Manifest,
    folder: str | Path,
    *,
    curriculum: Curriculum | None = None,
    log: Log | None = None,
    say: Callable[[str], None] = print,
    config: Mapping[str, Any] | None = None,
    resume: bool = False,
) -> Progress:
    """Train, keeping the policy that evaluates best in ``<folder>/policy`` and a checkpoint beside it.

    All episodes restart at every checkpoint, so a resumed run takes exactly the same steps as an uninterrupted run,
    even after a kill. SIGTERM and SIGINT write a checkpoint and end the run.

    Args:
        algorithm: algorithm that learns.
        environment: batched environment [env] with ``observation``, ``action`` and ``reward``; composites
            ``reward_terms`` and ``measure`` are logged. It must use its own random generators.
        evaluate: measures the policy.
        settings: settings of the run.
        manifest: manifest of the policy bundle; steps and updates are filled in.
        folder: folder of the run.
        curriculum: values of the task, passed to the environment's method ``set_terms``; None: none.
        log: receives the measures, for example for wandb.
        say: receives progress lines.
        config: plain values, kept in the checkpoint; a resumed run prints which of them have changed.
        resume: whether to continue from the checkpoint in the folder.

    Raises:
        ValueError: if the folder has a checkpoint and `resume` is false, if losses, observations or rewards are not
            finite, or if a checkpoint does not fit.
        FileNotFoundError: if there is no checkpoint to resume from.
    """
    folder, curriculum, config = Path(folder), curriculum or Curriculum(), dict(config or {})
    identity = _identity(algorithm, manifest, settings)
    if not resume:
        check_unused(folder)
    run = _resume(folder / CHECKPOINT, identity, config, algorithm, say) if resume else Progress()
    run.stopped = False
    counted = TransformedEnv(base_env=environment, transform=Compose(RewardSum(), StepCounter()))  # pyright: ignore[reportCallIssue]

    def follow_curriculum() -> None:
        if values := curriculum.at(run.steps):
            environment.set_terms(**values)  # pyright: ignore[reportCallIssue]

    def restart() -> Collector:
        """A collector with new episodes; resetting a used collector would zero tensors of the environment."""
        follow_curriculum()
        seed = settings.seed + run.steps
        torch.manual_seed(seed)
        algorithm.restart(seed)
        environment.set_seed(seed)
        return Collector(
            counted,
            algorithm.explorer,
            frames_per_batch=algorithm.settings.rollout * algorithm.environments,
            use_buffers=False,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )

    collector = restart()
    meter, began = _Meter(run, algorithm, settings), time.monotonic() - run.seconds
    with stop_requested() as stop, ThreadPoolExecutor(1, "collector", torch.set_num_threads, (1,)) as other:
        while run.steps < settings.steps and not run.stopped:
            algorithm.follow()
            follow_curriculum()
            coming = other.submit(collector.rollout)
            if not settings.overlap:
                coming.exception()  # waits
            meter.losses |= algorithm.learn()
            rollout = coming.result()
            before, run.steps = run.steps, run.steps + rollout.numel()
            meter.add(rollout)
            finished = run.steps >= settings.steps
            # read once: a later signal ends the run after the next rollout
            run.stopped = stop.is_set() and not finished
            restarting = finished or run.stopped or _passed(before, run.steps, settings.checkpoint_every)
            if restarting:  # all episodes are truncated here
                rollout["next", "done"][:, -1] = True
            meter.losses |= algorithm.take(rollout)

            run.seconds = time.monotonic() - began
            if _passed(before, run.steps, settings.log_every):
                measures = meter.take()
                run.history.append({"steps": run.steps, **measures})
                say(meter.line(measures))
                if log is not None:
                    log(measures, run.steps)
            if finished or _passed(before, run.steps, settings.evaluate_every):
                measures = _evaluate(run, algorithm, evaluate, manifest, folder)
                say(
                    f"{run.steps:>9,} steps  evaluation  " + "  ".join(f"{k[11:]} {v:.3g}" for k, v in measures.items())
                )
                if log is not None:
                    log(measures, run.steps)
            if restarting:
                _save(folder / CHECKPOINT, identity, config, run, algorithm)
                collector.shutdown(close_env=False)
                collector = restart()
    collector.shutdown(close_env=False)
    if not algorithm.updates:
        say(f"no update was made in {run.steps:,} steps: give more steps or a shorter warm-up")
    return run


def _finite(values: torch.Tensor) -> bool:
    return bool(torch.isfinite(values).all())


def _passed(before: int, now: int, every: int) -> bool:
    return before // every != now // every


def _evaluate(
    run: Progress, algorithm: Algorithm, evaluate: Evaluate, manifest: Manifest, folder: Path
) -> dict[str, float]:
    """Evaluate the policy and keep its bundle if it is the best so far."""
    measures = {f"evaluation/{name}": float(value) for name, value in evaluate(algorithm.act).items()}
    score = measures.get("evaluation/score", measures.get("evaluation/return", float("-inf")))
    run.history.append({"steps": run.steps, **measures})
    if score >= run.best:
        run.best, run.best_steps = score, run.steps
        training = dataclasses.replace(manifest.training, steps=run.steps, updates=algorithm.updates)
        algorithm.bundle(dataclasses.replace(manifest, training=training)).save(folder / POLICY, overwrite=True)
    return measures


def _identity(algorithm: Algorithm, manifest: Manifest, settings: TrainSettings) -> dict[str, Any]:
    """Values that a resumed run must not change, even if the tensor shapes agree."""
    return {
        "algorithm": type(algorithm).__name__,
        "task": manifest.task,
        "model": manifest.training.model_hash,
        "seed": settings.seed,
        "span": [list(manifest.action_map.position_low), list(manifest.action_map.position_high)],
        "algorithm.normalisation": algorithm.normalisation,
        "algorithm.clip": float(algorithm.settings.clip),
    }


def check_unused(folder: Path) -> None:
    """Raise an error if the folder contains a checkpoint."""
    if (folder / CHECKPOINT).exists():
        raise ValueError(
            f"{folder} has the {CHECKPOINT} of a run: continue with resume={folder}, or choose another folder"
        )


def _save(path: Path, identity: Mapping, config: Mapping, run: Progress, algorithm: Algorithm) -> None:
    state = {"identity": identity, "config": config, "run": dataclasses.asdict(run)}
    save_checkpoint(path, {**state, "algorithm": algorithm.state_dict()})


def _resume(
    path: Path, identity: Mapping, config: Mapping, algorithm: Algorithm, say: Callable[[str], None]
) -> Progress:
    state = load_checkpoint(path)
    if changed := [name for name, value in identity.items() if state["identity"].get(name, value) != value]:
        raise ValueError(
            f"{path}: is of a run with a different {', '.join(changed)}; resume with its overrides, or start a new run "
            "with warm_start=<its policy>"
        )
    had, has = flat(state["config"]), flat(config)
    for name in sorted(name for name in had.keys() | has.keys() if had.get(name) != has.get(name)):
        say(f"resumed with {name}={has.get(name)}, was {had.get(name)}")
    try:
        algorithm.load_state_dict(state["algorithm"])
        return Progress(**state["run"])
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ValueError(f"{path}: does not fit this run ({reason}); resume with its original settings") from None


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name; lists are kept."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


class _Meter:
    """Means between two log entries, for the log and the progress line."""

    def __init__(self, run: Progress, algorithm: Algorithm, settings: TrainSettings):
        self.run, self.algorithm, self.settings = run, algorithm, settings
        self.losses: dict[str, torch.Tensor] = {}
        self._start()

    def _start(self) -> None:
        self._since = time.monotonic(), self.run.steps, self.algorithm.updates
        self._sums: dict[str, list[float]] = {}

    def add(self, rollout: TensorDictBase) -> None:
        """Include a rollout [env, time].

        Raises:
            ValueError: if an observation or a reward is not finite.
        """
        after: Any = rollout["next"]
        for name in ("observation", "reward"):
            if not _finite(after[name]):
                terms = [f"reward_terms.{term}" for term, v in after.get("reward_terms", {}).items() if not _finite(v)]
                what = terms[0] if name == "reward" and terms else name
                raise ValueError(
                    f"the environment returned a non-finite {what}; check the task's terms and the model file"
                )
        values = {"reward": after["reward"], "action/spread": rollout["action"].std()}
        for kind in ("reward_terms", "measure"):
            values |= {f"{kind}/{name}": value for name, value in after.get(kind, {}).items()}
        if bool((done := after["done"]).any()):
            values["episode/return"] = after["episode_reward"][done]
            values["episode/length"] = after["step_count"][done]
            values["episode/terminated"] = after["terminated"][done]
        for name, value in values.items():
            self._sums.setdefault(name, []).append(float(value.float().mean()))

    def take(self) -> dict[str, float]:
        """The means since the last entry, the rates, and the last update's losses.

        Raises:
            ValueError: if a loss is not finite.
        """
        began, steps, updates = self._since
        seconds = max(time.monotonic() - began, 1e-9)
        measures = {name: sum(values) / len(values) for name, values in self._sums.items()}
        measures["speed/steps"] = (self.run.steps - steps) / seconds
        measures["speed/updates"] = (self.algorithm.updates - updates) / seconds
        measures |= {f"update/{name}": float(value) for name, value in self.losses.items()}
        for name, value in measures.items():
            if not torch.isfinite(torch.tensor(value)):
                raise ValueError(f"training diverged: {name} is {value}; lower the learning rates")
        self._start()
        return measures

    def line(self, measures: Mapping[str, float]) -> str:
        """Steps, speed, the latest episodes and the time left."""
        left = max(0, self.settings.steps - self.run.steps) / max(measures["speed/steps"], 1e-9)
        parts = [f"{self.run.steps:>9,} steps", f"{measures['speed/steps']:.0f}/s"]
        parts.append(f"{self.algorithm.updates:,} updates, {measures['speed/updates']:.0f}/s")
        if "episode/return" in measures:
            parts.append(f"return {measures['episode/return']:.1f} in {measures['episode/length']:.0f} steps")
        minutes, seconds = divmod(int(left), 60)
        return "  ".join([*parts, f"{minutes}:{seconds:02d} left"])
