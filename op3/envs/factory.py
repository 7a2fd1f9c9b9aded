"""One function that makes any environment of the project."""

from inspect import signature
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from op3.envs.batched import BatchedEnv
from op3.robot import load_robot
from op3.servo import RobotModel
from op3.sim import model_for
from op3.tasks.randomisation import ParameterRanges
from op3.tasks.task import Task, find_task

BACKENDS = ("batched", "composer")


def make_env(
    task: str | Task = "balance",
    model: str | Path | RobotModel = "own",
    num_envs: int | None = None,
    seed: int = 0,
    backend: str = "batched",
    randomisation: str | ParameterRanges | None = None,
    **options: Any,
) -> EnvBase:
    """An environment with the keys observation, action, reward, reward_terms, done, terminated and truncated.

    Args:
        task: a `Task`, or the name of one in ``conf/task``.
        model: a model, the path of a model.yaml, a name from `op3.sim.model_names`, or ``own``: the robot file's model,
            otherwise one built from its servo files.
        num_envs: number of robots; None: 64, or one with the composer backend, which supports only one.
        backend: ``batched`` steps all robots together; ``composer`` is the same task in dm_control composer.
        randomisation: "ranges" (Table I) or "intervals" (the model's) draws each robot's parameters for every
            episode; None: constant parameters.

    Raises:
        ValueError: if a name is unknown, or the backend does not support an option.
    """
    task = find_task(task)
    if not isinstance(model, RobotModel):
        name, model = model, model_for(load_robot(task.robot), None if model == "own" else model)
        if "current_pd" not in model.effect_names and task.action_map().gain_low is not None:
            raise ValueError(f"model={name}: its servos accept no P gains, but the task commands them; use model=paper")
    if isinstance(randomisation, str):
        randomisation = ParameterRanges(randomisation)  # type: ignore[arg-type]
    if randomisation is not None:
        task = task.changed({"events.randomisation": {"source": randomisation.source, "names": randomisation.names}})
    if backend not in BACKENDS:
        raise ValueError(f"unknown backend {backend!r}; the backends are {', '.join(BACKENDS)}")
    kind: Any = BatchedEnv
    if backend == "composer":
        from op3.envs.composed import ComposerEnv as kind  # imports composer, which training does not need
    taken = ("self", "task", "model", "num_envs", "seed")
    known = [name for name in signature(kind.__init__).parameters if name not in taken]
    if unknown := [name for name in options if name not in known]:
        raise ValueError(f"the {backend} environment has no option {unknown[0]!r}; it has {', '.join(known)}")
    if backend == "batched":
        return kind(task, model, 64 if num_envs is None else num_envs, seed, **options)
    if num_envs not in (None, 1) or "randomisation" in task.terms("events"):
        raise ValueError(
            f"the composer backend has one robot without randomisation, got {num_envs} with "
            f"randomisation={randomisation}: use backend='batched'"
        )
    return kind(task, model, seed, **options)
