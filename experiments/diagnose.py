"""Name the effects that a model does not include, from logs of a robot on the stand or of a servo on a bench.

python experiments/diagnose.py data=<folder of logs> model=<model.yaml or name in conf/servo>
python experiments/diagnose.py data=<folder of logs> model=paper mode=loop      # again from the returned model
python experiments/diagnose.py data=<folder of logs> model=paper mode=aliasing  # what these logs can show
python experiments/diagnose.py data=<folder> model=paper policy=assets/policies/balance [actual=<logs of its episodes>]
python experiments/diagnose.py planned=leg_suite mode=aliasing   # what a suite would show
python experiments/diagnose.py "planned=[squat_fast,multisine_legs]" mode=aliasing
"""

import time
from pathlib import Path
from typing import Any

import hydra
import torch
import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from support import Progress, check_given, library_motion, one_sentence, plain, run_folder, whole
from threadpoolctl import threadpool_limits

from op3.command_line import launch
from op3.diagnose import (
    Diagnosis,
    Settings,
    Verdict,
    aliasing,
    diagnosed_mount,
    on_other_mounts,
    split_logs,
    suited,
    with_chain,
)
from op3.diagnose.window_gaps import gap_table
from op3.identify.resolvers import chosen_model
from op3.policy import PolicyBundle
from op3.report.diagnosis import report_diagnosis
from op3.robot import DEFAULT, leg_suite
from op3.rollout import Rollout, read_logs
from op3.servo import effect_class
from op3.sim import model_for, save_model
from op3.tasks.planned import planned_motions, planned_suite

IMPORTED = time.process_time()


def planned_logs(cfg: DictConfig) -> list[Rollout]:
    """What the planned excitation would give, by the model."""
    model = with_chain(chosen_model(cfg))
    if cfg.planned == "leg_suite":
        return planned_suite(model, leg_suite(cfg.seed))
    names = [cfg.planned] if isinstance(cfg.planned, str) else plain(cfg.planned)
    return planned_motions(model, [library_motion(name, cfg.robot or DEFAULT) for name in names])


def attempts(cfg: DictConfig) -> tuple[PolicyBundle, list[Rollout]]:
    """The policy whose return is predicted, once it is known to fit the task, and its episodes on the robot."""
    policy = PolicyBundle.load(cfg.policy)
    instantiate(cfg.task).check_policy(policy.manifest, f"policy={cfg.policy}")
    actual = () if cfg.actual is None else read_logs(plain(cfg.actual))
    return policy, [episode for log in actual for episode in (log.episodes() if log.batched else [log])]


def returns(cfg: DictConfig, verdict: Verdict, policy: PolicyBundle, episodes: list[Rollout]) -> dict[str, Any]:
    """What a policy would return before and after, and what it did where its episodes are given."""
    from op3.envs.downstream import downstream  # brings TorchRL, which a diagnosis without a policy need not load

    options = {"task": instantiate(cfg.task), "episodes": cfg.episodes, "seed": cfg.seed, "progress": Progress()}
    return {"policy": str(cfg.policy)} | downstream(policy, verdict.base, verdict.model, actual=episodes, **options)


def diagnose(cfg: DictConfig, folder: Path) -> dict[str, Any]:
    """Diagnose, and write verdict, model and page into a folder."""
    if cfg.mode not in ("once", "loop", "aliasing"):
        raise ValueError(f"mode must be once, loop or aliasing, got {cfg.mode!r}")
    if cfg.planned and not OmegaConf.is_missing(cfg, "data"):
        raise ValueError("planned= and data= exclude each other: the one is simulated, the other was recorded")
    whole(cfg, "episodes", 1)
    for name in cfg.without:
        effect_class(name)
    if cfg.planned and cfg.mode != "aliasing":
        raise ValueError("planned= has no measurement to diagnose: add mode=aliasing, or give data= instead")
    attempted = None if cfg.policy is None else attempts(cfg)  # what is wrong with it is said before minutes of work
    data: Any = None if cfg.planned else plain(cfg.data)
    logs, others = diagnosed_mount(planned_logs(cfg) if cfg.planned else read_logs(data, cfg.robot))
    model = suited(model_for(logs[0].robot, cfg.model), logs)
    split = split_logs(logs, seed=cfg.seed)
    diagnosis = Diagnosis(
        model,
        split,
        seed=cfg.seed,
        without=tuple(cfg.without),
        settings=Settings(windows=cfg.windows),
        progress=Progress(),
    )
    if cfg.mode == "aliasing":
        content = aliasing(diagnosis, planned=bool(cfg.planned))
        (folder / "aliasing.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
        print(f"\n{content['sentence']}\n{folder / 'aliasing.yaml'}")
        return content
    verdict = diagnosis.run(cfg.rounds if cfg.mode == "loop" else 1)
    content = verdict.plain()
    if others:
        content["mount"] = logs[0].metadata.mount
        content["other_mounts"] = on_other_mounts(verdict.base, verdict.model, others, cfg.seed)
    save_model(verdict.model, folder / "model.yaml")
    if attempted is not None:
        content["downstream"] = returns(cfg, verdict, *attempted)
    content["processor_seconds"] = round(time.process_time() - IMPORTED, 1)
    print(f"\n{verdict.sentence}")
    if verdict.windows is not None:
        print(gap_table(verdict.windows))
    report_diagnosis(verdict, split, content, run_folder(cfg, folder, model="model.yaml"))
    # last, so that a verdict means that all is there
    (folder / "verdict.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return content


@hydra.main(config_path="../conf", config_name="diagnose", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Compose the config and diagnose."""
    with one_sentence(cfg=cfg):
        torch.set_num_threads(1)
        threadpool_limits(1)  # as in `Diagnosis.run`, for what is outside of it
        if not cfg.planned:
            check_given(cfg, "data", "a log or a folder of logs")
        diagnose(cfg, Path(HydraConfig.get().runtime.output_dir))


if __name__ == "__main__":
    launch(main, "diagnose", __doc__)
