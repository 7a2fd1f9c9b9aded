"""Run the whole method on a robot: collect, identify, train, deploy, and re-identify after a failed transfer.

op3 sim2real source=emulated task=balance world=random seed=0 [budget=demo|laptop|paper]
op3 sim2real task=walk world=robot_4 policy=assets/policies/walk    # start with an existing policy
op3 sim2real -m world=robot_1,robot_4 condition=excitation_only,reidentified,domain_randomisation

Every stage is a command with a separate folder. The same command with the same hydra.run.dir continues after an
interruption.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from op3.apps.collect import collect, exit_code
from op3.apps.command_result import CommandResult
from op3.apps.compose import configured
from op3.apps.current_run import output_folder, provenance
from op3.apps.diagnose import diagnose
from op3.apps.evaluate import evaluate
from op3.apps.fields import plain
from op3.apps.identify import identify
from op3.apps.job import goes_on
from op3.apps.reidentify import reidentify
from op3.apps.stages import Stages
from op3.apps.support import ASKED, check_same, library_motion, remember
from op3.apps.train import train
from op3.policy import PolicyBundle
from op3.replay import Prediction, Replay
from op3.report import RunFolder, read_result
from op3.report.transfer_page import report_transfers
from op3.report.video import film, states_of_log
from op3.rollout import Rollout, read_logs
from op3.scenes import build_scene
from op3.sim import load_model, model_hash
from op3.stand_in import HiddenWorld
from op3.tasks.evaluation import evaluation_return, stood, succeeded
from op3.tasks.task import find_task
from op3.transfer.attempt import Learned, Transfer
from op3.transfer.failed_episodes import ended_by, that_count

JUDGED = {"balance": "balance_eval", "walk": "walk"}
"""Evaluation task of each training task."""
ROBOTS = ("emulated", "real")
"""Sources that can run policies."""
UNHEARD = ("train.", "task.", "algorithm.", "environment", "evaluation.", "robot.")
"""Overrides without effect on the stages: budget, task and robot set these values."""
TOLD = {"balance": "Balancing on a board that tilts", "walk": "Walking"}
"""Names of tasks on the page."""
EXPECTED_SEED = 1_000_003
"""Offset of the seeds of simulated episodes; no training or evaluation uses these seeds."""
FILM_RATE = 25.0
"""Frames per second of the videos of the robot [Hz]."""


INTERRUPTED = goes_on("stages")


def sim2real(
    task: str = "balance",
    source: str = "emulated",
    *,
    world: str | None = None,
    port: str | None = None,
    condition: str | None = None,
    budget: str | None = None,
    policy: str | Path | None = None,
    rounds: int | None = None,
    seed: int = 0,
    folder: str | Path | None = None,
    overrides: Sequence[str] = (),
) -> CommandResult:
    """Collect, identify, train and deploy; after a failed transfer diagnose, re-identify and train again.

    Args:
        task: ``balance`` or ``walk``.
        source: ``emulated`` or ``real``.
        world: world of an emulated robot: a name in ``assets/worlds.yaml``, a path, or ``random``.
        port: serial port of a real robot.
        condition: a name under ``conditions`` in ``conf/sim2real.yaml``.
        budget: ``demo``, ``laptop`` or ``paper``.
        policy: folder of the bundle for the first transfer; None: one is trained.
        rounds: largest number of rounds after failed transfers.
        seed: seed of all random numbers.
        folder: folder of the run, where an interrupted run continues; None: a temporary folder.
        overrides: Hydra overrides of further settings in ``conf/sim2real.yaml``.

    Raises:
        ValueError: if an argument is invalid; the message says which one and how to fix it.
    """
    with configured("sim2real", **locals()) as cfg:
        return main(cfg)


def chosen(group: str) -> str:
    """The file of a config group that the command line chose."""
    return HydraConfig.get().runtime.choices[group]


def transfer(
    stages: Stages, cfg: DictConfig, budget: dict, number: int, policy: Path, model: str, began_with: str
) -> Transfer:
    """Run the policy in simulation and on the robot, and decide whether the transfer succeeded."""
    task = JUDGED[chosen("task")]
    episodes = budget["episodes"]
    expected = stages.run(
        f"{number}_expected",
        evaluate,
        policy=policy,
        model=model,
        task=task,
        episodes=episodes,
        seed=cfg.seed + EXPECTED_SEED,
        overrides=["logs=false"],
    )
    played = stages.run(f"{number}_robot", collect, **on_robot(cfg), policy=policy, task=task, repeats=episodes)
    logs = read_logs(played)
    returns = [evaluation_return(log, task) for log in logs]
    return Transfer(
        policy=policy,
        model=model,
        expected=tuple(read_result(expected / "result.yaml")["evaluation.returns"]),
        actual=tuple(returns),
        upright=tuple(stood(log) for log in logs),
        afterwards=sum("afterwards" in log.metadata.extra for log in logs),
        episodes=played,
        film=expected / "episode.mp4",
        robot_film=draw(logs[int(np.argmin(returns))], task, played / "episode.mp4"),
        criterion=cfg.criterion,
        began_with=began_with,
        walked=tuple(succeeded(log, task) for log in logs) if chosen("task") == "walk" else None,
    )


def draw(log: Rollout, task: str, path: Path) -> Path | None:
    """A video of an episode on the robot, rendered once; None if MuJoCo cannot render on this machine."""
    if path.exists():
        return path
    scene = build_scene(find_task(task).scene, log.robot)
    walks = find_task(task).cycle is not None
    return film(scene, states_of_log(log, scene, FILM_RATE), path, FILM_RATE, follow=walks)


def on_robot(cfg: DictConfig) -> dict[str, Any]:
    """Arguments of `collect` that select the robot."""
    where = {"source": chosen("source"), "seed": cfg.seed}
    if where["source"] == "emulated":
        return where | {"world": cfg.world, "world_seed": cfg.world_seed}
    return where | {"port": cfg.port}


def trained(stages: Stages, cfg: DictConfig, budget: dict, number: int, model: str, start: Path | str | None) -> Path:
    """Train a policy on a model, starting from an earlier policy if there is one; return the bundle."""
    how = budget["train" if start is None else "retrain"]
    condition = cfg.conditions[cfg.condition]
    randomised = condition.get("randomisation")
    more = [f"+environment.randomisation={randomised}"] if randomised else []
    arguments = {"task": chosen("task"), "model": model, "seed": cfg.seed + 100 * number, "warm_start": start}
    return stages.run(f"{number}_train", train, **arguments, overrides=[*how, *more]) / "policy"


def check(cfg: DictConfig) -> dict[str, Any]:
    """The budget. Checks the whole config before any stage runs.

    Raises:
        ValueError: naming the invalid field.
    """
    if cfg.condition not in cfg.conditions or chosen("task") not in JUDGED:
        raise ValueError(
            f"condition must be one of {', '.join(cfg.conditions)} and task one of {', '.join(JUDGED)};"
            f" got {cfg.condition}, {chosen('task')}"
        )
    if chosen("source") not in ROBOTS:
        raise ValueError(
            f"source must be {' or '.join(ROBOTS)}: it must be able to run a policy; got {chosen('source')}"
        )
    name = chosen("budget")
    if name not in cfg.budgets:
        raise ValueError(f"budget must be one of {', '.join(cfg.budgets)}, got {name}")
    if not 0 < cfg.criterion <= 10:  # a larger value was probably meant in per cent
        raise ValueError(f"criterion must be a share of the expected return (0.8 for 80 %), got {cfg.criterion}")
    if chosen("source") == "emulated":
        HiddenWorld.find(cfg.world, cfg.world_seed)
    load_model(cfg.conditions[cfg.condition].get("model", cfg.model))
    if not isinstance(cfg.diagnose, bool | None):
        raise ValueError(f"diagnose must be true, false, or null (set by the condition), got {cfg.diagnose!r}")
    for motion in plain(cfg.diagnosis):
        library_motion(motion)
    forwarded = [override for override in HydraConfig.get().overrides.task if override.startswith(UNHEARD)]
    if forwarded:
        raise ValueError(
            f"{forwarded[0]} has no effect on any stage; add it to the overrides of the stage,"
            f" 'budgets.{name}.train=[...]'"
        )
    return OmegaConf.to_container(cfg.budgets[name], resolve=True)  # type: ignore[return-value]


def trained_on(cfg: DictConfig) -> str:
    """The model that the given policy was trained on; it determines the expected return.

    Raises:
        ValueError: if it is not available.
    """
    made = PolicyBundle.load(cfg.policy).manifest
    if made.task not in (chosen("task"), JUDGED[chosen("task")]):
        raise ValueError(f"policy={cfg.policy} was trained for {made.task}, not for {chosen('task')}")
    name = made.training.model if cfg.trained_on is None else cfg.trained_on
    try:
        known = model_hash(load_model(name))
    except (ValueError, FileNotFoundError):
        known = ""
    if made.training.model_hash and known != made.training.model_hash:
        raise ValueError(
            f"policy={cfg.policy} was trained on the model {made.training.model_hash}, but {name} is a different model;"
            " give trained_on=<its model.yaml>"
        )
    return str(name)


def loop(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """Run all stages in order."""
    budget = check(cfg)
    condition = cfg.conditions[cfg.condition]
    diagnoses = bool(condition.get("diagnose")) if cfg.diagnose is None else cfg.diagnose
    base = condition.get("model", cfg.model)
    learns = bool(condition.get("reidentify") or condition.get("retrain") or diagnoses)
    groups = list(condition.groups) if "groups" in condition else None
    # an invalid policy is rejected before anything is recorded
    promising = None if cfg.policy is None else trained_on(cfg)
    # a later run may add rounds
    what = {name: plain(cfg[name]) for name in ("condition", "criterion", "policy", "diagnose", "warm_start", "seed")}
    what |= {group: chosen(group) for group in ("task", "source", "budget")}
    check_same(folder / ASKED, what)
    remember(folder / ASKED, what)
    stages = Stages(folder, None if cfg.shared is None else Path(cfg.shared).absolute())
    squat = stages.run("squat", collect, **on_robot(cfg), motion="squat")
    heldout = stages.run("squat_heldout", collect, **on_robot(cfg), motion="squat_heldout")

    def identified() -> str:
        logs = {"data": squat, "heldout": heldout, "model": base, "seed": cfg.seed, "groups": groups}
        method = None if any(each.startswith("method=") for each in budget["identify"]) else "lsq"
        made = stages.run("identify", identify, **logs, method=method, ablate=[], overrides=budget["identify"])
        return str(made / "model.yaml")

    randomised = condition.get("randomisation") is not None
    start = budget.get("start", {}).get(chosen("task"))
    if promising is not None:
        model, policy, began = promising, Path(str(cfg.policy)), "given"
    else:
        model = base if condition.get("randomisation") == "ranges" else identified()
        policy, began = trained(stages, cfg, budget, 0, model, start), start or "nothing"
    transfers = [transfer(stages, cfg, budget, 0, policy, model, began)]
    learned = Learned()
    for number in range(1, cfg.rounds + 1):
        # a given policy was trained without data of this robot, so the robot is identified before training
        unseen = number == 1 and promising is not None and not randomised
        if transfers[-1].success or not (learns or unseen):
            break
        if unseen:
            model = identified()
        if diagnoses:
            model = diagnosed(stages, cfg, number, model, policy, transfers[-1], learned)
        if condition.get("reidentify"):
            model = reidentified(
                stages, cfg, number, model, squat, transfers[-1], groups, budget["reidentify"], learned
            )
        began = f"the policy of round {number - 1}" if cfg.warm_start else start or "nothing"
        policy = trained(stages, cfg, budget, number, model, policy if cfg.warm_start else start)
        transfers.append(transfer(stages, cfg, budget, number, policy, model, began))
    learned.spared = learns and len(transfers) == 1 and transfers[0].success
    return report(cfg, chosen("budget"), folder, stages, transfers, learned)


def diagnosed(
    stages: Stages, cfg: DictConfig, number: int, model: str, policy: Path, failed: Transfer, learned: Learned
) -> str:
    """The model with the effects that a diagnosis names from stand logs, and its gain on the failed episodes."""
    stand = stages.on_stand("stand", list(cfg.diagnosis), on_robot(cfg))
    worth = {"policy": policy, "actual": failed.episodes, "task": JUDGED[chosen("task")]}
    found = stages.run(f"{number}_diagnose", diagnose, data=stand, model=model, seed=cfg.seed, **worth)
    verdict = yaml.safe_load((found / "verdict.yaml").read_text(encoding="utf-8"))
    returns = {name: verdict["downstream"][name]["mean"] for name in ("before", "after", "actual")}
    learned.named[number] = (
        f"{verdict['sentence']} Expected return of the failed policy: {returns['before']:.3g} with the refitted"
        f" model, {returns['after']:.3g} with the diagnosed model; {returns['actual']:.3g} on the robot."
    )
    return str(found / "model.yaml")


def reidentified(
    stages: Stages,
    cfg: DictConfig,
    number: int,
    model: str,
    squat: Path,
    failed: Transfer,
    groups: list[str] | None,
    how: list[str],
    learned: Learned,
) -> str:
    """The model that matches the returns of the failed episodes whose end a simulation can reproduce."""
    counting, others = that_count(read_logs(failed.episodes))
    if not counting:
        learned.remarks.append(
            f"Nothing was re-identified in round {number}: all episodes ended because of {ended_by(others)}, which no"
            " simulation of the policy can reproduce."
        )
        return model
    where = {"policy": failed.policy, "model": model, "data": squat, "episodes": failed.episodes, "groups": groups}
    start = "diagnosed" if number in learned.named else "re-identified before" if number > 1 else "excitation only"
    more = {"task": JUDGED[chosen("task")], "seed": cfg.seed, "start_name": start}
    found = stages.run(f"{number}_reidentify", reidentify, **where, **more, overrides=how)
    learned.numbers[number] = read_result(found / "result.yaml")
    return str(found / "model.yaml")


def what_is_done(cfg: DictConfig) -> str:
    """Task and robot as text for the page."""
    robot = f"The robot is emulated; its parameters, `{cfg.world}`, are hidden from identification and training."
    return f"{TOLD[chosen('task')]}. {robot if chosen('source') == 'emulated' else 'The robot is real.'}"


def squat_fit(folder: Path) -> dict[str, Prediction]:
    """Errors of the identified models on the squat, with and without DTE if both were requested."""
    models = {"identified": folder / "identify" / "model.yaml"}
    without = folder / "identify" / "model_without_dte.yaml"
    if without.is_file():
        models = {"with DTE": models["identified"], "without DTE": without}
    found = {label: load_model(path) for label, path in models.items() if path.is_file()}
    replay = Replay(read_logs(folder / "squat")[:1], num_threads=1) if found else None
    return {label: replay.run(model)[0] for label, model in found.items()} if replay else {}


def learning(folder: Path, stages: Stages) -> dict[str, tuple[list[float], list[float]]]:
    """Learning curves of all trainings."""
    runs = {name: read_result(folder / name / "result.yaml") for name in stages.seconds if name.endswith("_train")}
    return {
        f"round {name.split('_')[0]}": (run["learning.steps"], run["learning.return"])
        for name, run in runs.items() if run.get("learning.steps")
    }  # fmt: skip


def following(folder: Path, last: Transfer) -> list[str]:
    """Commands to run next."""
    episode = next(iter(sorted(path for path in last.episodes.iterdir() if path.is_dir() and path.name[0] != ".")), "")
    return [
        f"op3 view {episode}  # an episode on the robot",
        f"op3 view {last.policy}  # the same policy in simulation",
        "op3 demo diagnose  # hides an effect in a robot and names it from logs",
    ]


def report(
    cfg: DictConfig, budget: str, folder: Path, stages: Stages, transfers: list[Transfer], learned: Learned
) -> dict[str, Any]:
    """Write the page of the run and its numbers."""
    world = cfg.world if chosen("source") == "emulated" else "real"
    return report_transfers(
        transfers,
        learned,
        RunFolder(folder, provenance(cfg)),
        asked={"task": chosen("task"), "world": world, "condition": cfg.condition, "budget": budget},
        seconds=stages.seconds,
        processor_seconds=stages.processor_seconds,
        what=what_is_done(cfg),
        fit=squat_fit(folder),
        learning=learning(folder, stages),
        following=following(folder, transfers[-1]),
    )


def main(cfg: DictConfig) -> CommandResult:
    """Run all stages; a sweep maximises the return on the robot as a share of the expected return."""
    folder = output_folder().absolute()
    with exit_code():
        values = loop(cfg, folder)
    share = values[f"transfer_{values['rounds']}"]["share"]
    return CommandResult(folder, values["headline"], values, share)
