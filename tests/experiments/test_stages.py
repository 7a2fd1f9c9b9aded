"""Stages of longer commands, each done once."""

import pytest

from op3.apps.collect import collect
from op3.apps.predict import predict
from op3.apps.stages import DONE, Stages
from op3.deploy.exit_codes import Stop


def test_runs_share_the_stages_with_the_same_arguments(tmp_path, capsys):
    """What is the same but for the run's folder is done once; what differs gets a folder of its own."""
    squats = {}
    for name, motion in (("a", "squat"), ("b", "squat"), ("c", "squat_fast")):
        (tmp_path / name).mkdir()
        stages = Stages(tmp_path / name, tmp_path / "shared")
        squats[name] = stages.run("squat", collect, source="model", mount="stand", motion=motion)
        shown = stages.run("1_predict", predict, data=squats[name], model="paper")
        assert (shown / "result.yaml").exists()
    assert squats["a"].resolve() == squats["b"].resolve() != squats["c"].resolve()
    assert len(list((tmp_path / "shared").glob(f"squat-*/{DONE}"))) == 2
    assert len(list((tmp_path / "shared").glob(f"predict-*/{DONE}"))) == 2
    said = capsys.readouterr().out
    assert said.count("already finished") == 2
    assert said.count("1 recording: ") == 2


def test_a_stage_that_is_refused_can_be_corrected(tmp_path):
    """Its error names the stage, and the same stage takes other arguments afterwards, for nothing was done."""
    stages = Stages(tmp_path)
    with pytest.raises(ValueError, match="stage squat: there is no model file 'pape'"):
        stages.run("squat", collect, source="model", mount="stand", model="pape")
    assert stages.run("squat", collect, source="model", mount="stand", overrides=["motion.duration=0.5"]).is_dir()


def test_a_robot_that_falls_before_a_recording_names_the_stage(tmp_path):
    """Its weak motors and heavy trunk let it fall in its home pose, before the motion."""
    world = tmp_path / "world.yaml"
    world.write_text("draw: 201\n", encoding="utf-8")
    told = "stage hold: the trunk is tilted by .*, before the recording hold-0 began; run the same command"
    with pytest.raises(Stop, match=told):
        Stages(tmp_path).run("hold", collect, source="emulated", world=world, motion="hold")
