"""Write a model for another simulator, and measure the error without the effects that its format cannot represent.

op3 export model=<model.yaml> to=mjcf|bam [data=<logs>] [robot=<robot>] [out=<file>]

mjlab and MuJoCo Playground read the MJCF unchanged. Every command reads BAM's JSON as `model=<file>.json`.
"""

import json
from pathlib import Path

from omegaconf import DictConfig

from op3.apps.command_result import CommandResult
from op3.apps.current_run import output_folder
from op3.apps.fields import plain
from op3.common.writing import write_text
from op3.identify.prediction_score import predict_logs
from op3.robot import load_robot
from op3.rollout import read_logs
from op3.sim import model_for
from op3.sim.foreign_models import EXPRESSES, expressed, to_bam, to_mjcf


def main(cfg: DictConfig) -> CommandResult:
    """Write the file, list the omitted effects, and measure how much larger the error on the logs is without them."""
    if cfg.to not in EXPRESSES:
        raise ValueError(f"to={cfg.to}: write one of {', '.join(EXPRESSES)}; mjlab and Playground take mjcf")
    logs = read_logs(plain(cfg.data), cfg.robot) if cfg.data is not None else []
    if logs:
        robot = logs[0].robot
    elif cfg.robot is not None:
        robot = load_robot(cfg.robot)
    else:
        raise ValueError("robot: name the robot of the model, or give the logs that it was fitted to as data=")
    model = model_for(robot, cfg.model)
    kept, lost = expressed(model, cfg.to)
    if cfg.to == "bam":
        joint = cfg.joint or robot.joints[0]
        robot.indices([joint])
        text = json.dumps(to_bam(model, robot.servo(joint).name, joint), indent=1) + "\n"
    else:
        text = to_mjcf(model, robot, cfg.p_gain, cfg.d_gain)
    out = Path(cfg.out or f"{robot.name}.{'json' if cfg.to == 'bam' else 'xml'}")
    write_text(out, text)
    said = f"Omitted effects: {', '.join(lost)}." if lost else "The file includes all effects of the model."
    if logs:
        errors = [predict_logs(one, logs).error_mrad for one in (model, kept)]
        if errors[0] is not None and errors[1] is not None:
            said += f" Position error on the logs: {errors[0].value:.3g} mrad with the model,"
            said += f" {errors[1].value:.3g} mrad with the effects that {cfg.to} can represent."
    return CommandResult(output_folder(), said, files=(out,))
