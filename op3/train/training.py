"""The training loop: collect, update, evaluate, save."""

import dataclasses
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from tensordict import TensorDict

from op3.policy import Manifest
from op3.policy.mirror import Mirror
from op3.settings import Count, NotNegative, Number, Whole, settings
from op3.train.checkpoint import load_checkpoint, save_checkpoint, stop_requested
from op3.train.collector import STORED, Collector, Episodes, Policy
from op3.train.explorer import Explorer
from op3.train.practice import Practice
from op3.train.replay_buffer import Batch, ReplayBuffer
from op3.train.sac import SAC

CHECKPOINT = "checkpoint.pt"
POLICY = "policy"

Evaluate = Callable[[Policy], Mapping[str, float]]
"""Measures of a policy without exploration; ``score`` or else ``return`` says which is best."""

Log = Callable[[Mapping[str, float], int], None]
"""Takes measures by name and the number of environment steps."""


Bold = Annotated[Number, Field(ge=1)]


@settings()
class TrainSettings:
    """Settings of a run; one step is one policy step of one environment.

    Attributes:
        steps: of the whole run.
        warmup: steps before the first update, taken by the untrained policy.
        noise: exploration of the boldest environment, in multiples of the policy's standard deviation; the others lie
            between it and 1, evenly in the logarithm. It shows the critics what is wrong with larger actions.
        warmup_noise: the same during the warm-up.
        rollout: steps of every environment between updates.
        updates_per_step: updates per step after the warm-up.
        overlap: whether updates are made while the next rollout is collected, each on a core of its own, or after it.
            The result is the same to the last bit: the updates of a rollout always follow the one after it.
        buffer: steps kept in the replay buffer.
        normalisation: `running`, observations are measured all along, or `fixed`, during the warm-up only.
        evaluate_every: steps between evaluations.
        checkpoint_every: steps between checkpoints.
        checkpoint_buffer: whether the replay buffer is saved too; without it a resumed run fills a new one first.
        log_every: steps between log entries and progress lines.
        seed: of everything random.
    """

    steps: Count = 300_000
    warmup: Count = 5_000
    noise: Bold = 1.0
    warmup_noise: Bold = 1.0
    rollout: Count = 8
    updates_per_step: NotNegative = 0.25
    overlap: bool = True
    buffer: Count = 300_000
    normalisation: Literal["running", "fixed"] = "running"
    evaluate_every: Count = 20_000
    checkpoint_every: Count = 100_000
    checkpoint_buffer: bool = True
    log_every: Count = 5_000
    seed: Whole = 0


@dataclasses.dataclass
class Progress:
    """How far a run has come.

    Attributes:
        steps: environment steps taken.
        learned: of these, how many have brought their updates.
        best: highest score of an evaluation.
        best_steps: at how many steps that was.
        history: one entry per log entry and evaluation, with ``steps``.
        seconds: wall time of training [s], evaluations included, over all resumptions.
        stopped: whether a signal ended the run early.
    """

    steps: int = 0
    learned: int = 0
    best: float = float("-inf")
    best_steps: int = 0
    history: list[dict[str, float]] = dataclasses.field(default_factory=list)
    seconds: float = 0.0
    stopped: bool = False


def train(
    sac: SAC,
    collector: Collector,
    evaluate: Evaluate,
    settings: TrainSettings,
    manifest: Manifest,
    folder: str | Path,
    *,
    practice: Practice | None = None,
    mirror: Mirror | None = None,
    log: Log | None = None,
    say: Callable[[str], None] = print,
    resume: bool = False,
) -> Progress:
    """Train, keeping the policy that evaluates best in ``<folder>/policy`` and a checkpoint beside it.

    The environments begin new episodes at every checkpoint, so a run resumed from one takes the very steps that the
    run without interruption takes, also after a kill. SIGTERM and SIGINT make a checkpoint and end the run.

    Args:
        sac: the learner.
        collector: of the training environments.
        evaluate: measures the policy.
        settings: of the run.
        manifest: of the policy bundle; steps and updates are filled in.
        folder: of the run.
        practice: curricula; None: none.
        mirror: images of samples, which `practice.mirrored` needs.
        log: takes the measures, for example to wandb.
        say: takes progress lines.
        resume: go on from the checkpoint in the folder.

    Raises:
        ValueError: if losses are not finite, or a checkpoint does not fit.
        FileNotFoundError: if there is no checkpoint to resume from.
    """
    folder, practice = Path(folder), practice or Practice()
    size, action_size = manifest.observation_size, manifest.action_map.size
    replay = ReplayBuffer(settings.buffer, collector.count, size, action_size, sac.device)
    identity = _identity(manifest, settings)
    run = _resume(folder / CHECKPOINT, identity, manifest, sac, replay, say) if resume else Progress()
    run.stopped = False
    explorer = Explorer(sac, collector.count, settings.seed + run.steps)
    if settings.steps <= settings.warmup:
        say(f"no update will be made: the warm-up takes {settings.warmup:,} steps and the run has {settings.steps:,}")
    collector.practise(practice.at(run.steps))
    collector.restart(settings.seed + run.steps)
    meter, began = _Meter(run, sac, settings), time.monotonic() - run.seconds
    with stop_requested() as stop, ThreadPoolExecutor(1, "collector", torch.set_num_threads, (1,)) as other:
        stopping = False
        while run.steps < settings.steps and not stopping:
            explorer.follow(settings.warmup_noise if run.steps < settings.warmup else settings.noise)
            collector.practise(practice.at(run.steps))
            coming = other.submit(collector.collect, explorer, settings.rollout)
            if not settings.overlap:
                coming.exception()  # waits
            # after a resumption without the buffer it is filled first
            ready = len(replay) >= min(settings.warmup, settings.buffer)
            for _ in range(_due(run.learned, run.steps, settings) if ready else 0):
                meter.losses = sac.update(_sample(sac, replay, practice.mirrored, mirror))
            rollout, episodes = coming.result()
            before = run.learned = run.steps
            run.steps += rollout.numel()
            replay.extend(*(rollout[name] for name in STORED))
            if settings.normalisation == "running" or before < settings.warmup:
                sac.normaliser.update(rollout["observation"])

            meter.add(rollout, episodes)
            run.seconds = time.monotonic() - began
            if _passed(before, run.steps, settings.log_every):
                measures = meter.take()
                run.history.append({"steps": run.steps, **measures})
                say(meter.line(measures))
                if log is not None:
                    log(measures, run.steps)

            if _passed(before, run.steps, settings.evaluate_every) or run.steps >= settings.steps:
                _evaluate(run, sac, evaluate, manifest, folder, log, say)
            # asked once: a signal that comes later ends the run after the next rollout
            stopping = stop.is_set()
            if _passed(before, run.steps, settings.checkpoint_every) or run.steps >= settings.steps or stopping:
                run.stopped = run.steps < settings.steps and stopping
                replay.cut()
                stored = replay if settings.checkpoint_buffer else None
                _save(folder / CHECKPOINT, identity, manifest, run, sac, stored)
                collector.practise(practice.at(run.steps))
                collector.restart(settings.seed + run.steps)
                explorer.restart(settings.seed + run.steps)
    return run


def _sample(sac: SAC, replay: ReplayBuffer, mirrored: float, mirror: Mirror | None) -> Batch:
    """A batch, part of which is seen in the mirror."""
    settings = sac.settings
    batch = replay.sample(settings.batch, settings.n_step, settings.discount, sac.generator)
    part = slice(0, round(mirrored * settings.batch))
    if mirror is not None and part.stop:
        batch.observation[part] = mirror.observation(batch.observation[part])
        batch.action[part] = mirror.action(batch.action[part])
        batch.next_observation[part] = mirror.observation(batch.next_observation[part])
    return batch


def _due(before: int, now: int, settings: TrainSettings) -> int:
    """Updates that a rollout from `before` to `now` steps brings."""
    done, wanted = (int(max(steps - settings.warmup, 0) * settings.updates_per_step) for steps in (before, now))
    return wanted - done


def _passed(before: int, now: int, every: int) -> bool:
    return before // every != now // every


def _evaluate(
    run: Progress,
    sac: SAC,
    evaluate: Evaluate,
    manifest: Manifest,
    folder: Path,
    log: Log | None,
    say: Callable[[str], None],
) -> None:
    """Measure the policy and keep its bundle where it is the best so far."""
    measures = {f"evaluation/{k}": float(v) for k, v in evaluate(partial(sac.act, explore=0.0)).items()}
    score = measures.get("evaluation/score", measures.get("evaluation/return", float("-inf")))
    run.history.append({"steps": run.steps, **measures})
    if score >= run.best:
        run.best, run.best_steps = score, run.steps
        training = dataclasses.replace(manifest.training, steps=run.steps, updates=sac.updates)
        sac.bundle(dataclasses.replace(manifest, training=training)).save(folder / POLICY, overwrite=True)
    say(f"{run.steps:>9,} steps  evaluation  " + "  ".join(f"{k[11:]} {v:.3g}" for k, v in measures.items()))
    if log is not None:
        log(measures, run.steps)


def _identity(manifest: Manifest, settings: TrainSettings) -> dict[str, Any]:
    """What a run must keep when it goes on: of another of these no tensor's shape would tell."""
    return {
        "task": manifest.task,
        "model": manifest.training.model_hash,
        "seed": settings.seed,
        "span": [list(manifest.action_map.position_low), list(manifest.action_map.position_high)],
        "train.normalisation": manifest.normalisation,
        "sac.clip": float(manifest.clip),
    }


def _save(
    path: Path, identity: dict[str, Any], manifest: Manifest, run: Progress, sac: SAC, replay: ReplayBuffer | None
) -> None:
    states = {"sac": sac.state_dict(), "replay": None if replay is None else replay.state_dict()}
    settings = flat(manifest.training.settings)
    save_checkpoint(path, {"run": dataclasses.asdict(run), "identity": identity, "settings": settings, **states})


def _resume(
    path: Path, identity: dict[str, Any], manifest: Manifest, sac: SAC, replay: ReplayBuffer, say: Callable[[str], None]
) -> Progress:
    state = load_checkpoint(path)
    known = state["identity"]
    if changed := [name for name, value in identity.items() if known.get(name, value) != value]:
        raise ValueError(
            f"{path}: is of a run with another {', '.join(changed)}; resume with the overrides it had, or begin anew "
            "with warm_start=<its policy>"
        )
    had, has = state["settings"], flat(manifest.training.settings)
    for name in sorted(name for name in had.keys() | has.keys() if had.get(name) != has.get(name)):
        say(f"resumed with {name}={has.get(name)}, which was {had.get(name)}")
    try:
        sac.load_state_dict(state["sac"])
        if state["replay"] is not None:
            replay.load_state_dict(state["replay"])
        return Progress(**state["run"])
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        reason = str(error).split("\n")[0]
        raise ValueError(f"{path}: does not fit this run ({reason}); resume with the settings it had") from None


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name, lists as they are."""
    found: dict[str, Any] = {}
    for name, value in settings.items():
        found |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return found


class _Meter:
    """Means between two log entries, and the progress line."""

    def __init__(self, run: Progress, sac: SAC, settings: TrainSettings):
        self.run, self.sac, self.settings = run, sac, settings
        self.losses: dict[str, torch.Tensor] = {}
        self._start()

    def _start(self) -> None:
        self._since = time.monotonic(), self.run.steps, self.sac.updates
        self._sums: dict[str, list[float]] = {}

    def add(self, rollout: TensorDict, episodes: Episodes) -> None:
        """Take a rollout into account."""
        action, joints = rollout["action"], rollout["action"].shape[-1] // 2
        values = {"reward": rollout["reward"].mean(), "action/angle_spread": action[..., :joints].std()}
        values["action/gain"] = action[..., joints:].mean()
        values |= {name: rollout[name].mean() for name in rollout.keys() if "/" in str(name)}  # noqa: SIM118
        if len(episodes.returns):
            values["episode/return"] = episodes.returns.mean()
            values["episode/length"] = episodes.lengths.float().mean()
            values["episode/terminated"] = episodes.terminated.float().mean()
        for name, value in values.items():
            self._sums.setdefault(str(name), []).append(float(value))

    def take(self) -> dict[str, float]:
        """The means since the last entry, the rates, and the last update's losses.

        Raises:
            ValueError: if a loss is not finite.
        """
        began, steps, updates = self._since
        seconds = max(time.monotonic() - began, 1e-9)
        measures = {name: sum(values) / len(values) for name, values in self._sums.items()}
        measures["speed/steps"] = (self.run.steps - steps) / seconds
        measures["speed/updates"] = (self.sac.updates - updates) / seconds
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
        parts.append(f"{self.sac.updates:,} updates, {measures['speed/updates']:.0f}/s")
        if "episode/return" in measures:
            parts.append(f"return {measures['episode/return']:.1f} in {measures['episode/length']:.0f} steps")
        minutes, seconds = divmod(int(left), 60)
        return "  ".join([*parts, f"{minutes}:{seconds:02d} left"])
