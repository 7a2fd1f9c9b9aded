"""The page docs/your_robot.md does what it says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from op3.rollout import read_log
from op3.sim import load_model

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "your_robot.md").read_text()
MODEL = """<mujoco model="my_arm"><compiler angle="radian"/><worldbody><body name="base"><body name="upper">
<joint name="shoulder" axis="0 1 0" range="-2 2"/><geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" mass="0.1"/>
<body name="lower" pos="0 0 0.1"><joint name="elbow" axis="0 1 0" range="-2 2"/>
<geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" mass="0.1"/></body></body></body></worldbody></mujoco>"""


@pytest.mark.slow
def test_the_page_runs_from_top_to_bottom(tmp_path):
    """Its robot file and its commands, as they stand there."""
    (tmp_path / "my_arm.xml").write_text(MODEL)
    file, *_ = re.findall(r"```yaml\n(.*?)```", PAGE, re.S)
    (tmp_path / "my_arm.yaml").write_text(file)
    for command in re.findall(r"```bash\npython (\S+) (.*?)\n```", PAGE):
        script, options = command
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "WANDB_MODE": "disabled"}
        asked = [sys.executable, str(ROOT / script), *options.split()]
        done = subprocess.run(asked, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert read_log(tmp_path / "runs/one/multisine-0").joints == ("shoulder", "elbow")
    assert (tmp_path / "runs/predicted/index.html").is_file()
    assert load_model(tmp_path / "runs/found").estimate("coulomb_friction").value > 0
