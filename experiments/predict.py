"""How well a model predicts logs that it has not seen: open-loop replays, errors with 90 % intervals.

python experiments/predict.py model=<model.yaml or name> data=<logs> [where='{firmware_gain: 8}']
python experiments/predict.py -m model=outputs/identify/<run>,paper data=<logs>
"""

import time
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from support import check_given, focus_joints, logs_where, one_sentence, plain, run_folder

from op3.command_line import launch
from op3.identify.prediction_score import predict_logs
from op3.report.prediction_page import report_prediction
from op3.rollout import read_logs
from op3.sim import find_model, model_for


@hydra.main(config_path="../conf", config_name="predict", version_base="1.3")
def main(cfg: DictConfig) -> dict[str, Any]:
    """Predict, measure, report."""
    with one_sentence(cfg=cfg):
        torch.set_num_threads(1)
        started = time.monotonic()
        check_given(cfg, "data", "a log, a folder of logs, or a list of them")
        logs = logs_where(read_logs(plain(cfg.data), cfg.robot), plain(cfg.where), "where")
        joints = focus_joints(plain(cfg.joints), logs)
        score = predict_logs(
            model_for(logs[0].robot, cfg.model), logs, joints=joints, bench_timestep=cfg.bench_timestep, seed=cfg.seed
        )
        path = Path(f"{logs[0].robot.name}'s data sheets") if cfg.model is None else find_model(cfg.model)
        return report_prediction(
            score,
            run_folder(cfg, Path(HydraConfig.get().runtime.output_dir)),
            model=path.parent.name if path.name == "model.yaml" else path.stem,
            wall_seconds=time.monotonic() - started,
            joints=joints,
        )


if __name__ == "__main__":
    launch(main, "predict", __doc__)
