"""Logs of several mounts: which are diagnosed, and what is shown of the others."""

import pytest

from op3.common.assets import asset_path
from op3.diagnose import Diagnosis, LogSplit, diagnosed_mount, on_other_mounts
from op3.motions import chirp, squat
from op3.replay import simulate_motion
from op3.rollout import LogError, Rollout
from op3.sim import load_model


@pytest.fixture(scope="module")
def logs() -> list[Rollout]:
    """A squat on the floor, twice, and one on the stand."""
    model, short = load_model("paper"), squat(duration=1.0)
    floor, stand = (simulate_motion(model, short, mount=mount) for mount in ("floor", "stand"))
    return [floor, stand, floor]


def test_the_stand_is_diagnosed_and_the_floor_kept_apart(logs):
    """Of logs of both the stand's are diagnosed; of logs of one mount all are."""
    mine, others = diagnosed_mount(logs)
    assert [log.metadata.mount for log in mine] == ["stand"]
    assert {mount: len(kept) for mount, kept in others.items()} == {"floor": 2}
    assert diagnosed_mount(logs[::2]) == (logs[::2], {})


def test_a_bench_among_a_robots_logs_is_refused(logs):
    """They are two machines, and the message says what to do."""
    bench = Rollout(logs[0].data, logs[0].metadata.replace(mount="pendulum", mass=0.5, length=0.1))
    with pytest.raises(LogError, match="diagnose them separately"):
        diagnosed_mount([*logs, bench])


def test_logs_of_other_joints_are_refused(logs):
    """A limb alone and the whole robot are diagnosed one after the other; the message names the log."""
    whole = logs[1]
    arrays = {key: whole.array(key)[:, :3] for key in whole.channels if key[0] in ("joint", "command")}
    arrays["time"] = whole.array("time")
    part = Rollout.from_arrays(arrays, whole.metadata.replace(joints=whole.joints[:3], recording="part"))
    with pytest.raises(LogError, match=r"part.*joints differ from those of"):
        diagnosed_mount([whole, part])


@pytest.mark.parametrize(("field", "other"), [("robot_file", "robot"), ("robot", "real"), ("servo", "xl330")])
def test_different_machines_are_refused(logs, tmp_path, field, other):
    """Logs of another robot, or of other servos, are not diagnosed together."""
    if field == "robot_file":  # another OP3, with joints of the same names
        text = asset_path("robots/op3.yaml").read_text().replace("../op3/", f"{asset_path('op3/op3.xml').parent}/")
        (tmp_path / "op3.yaml").write_text(text)
        other = str(tmp_path / "op3.yaml")
    stranger = Rollout(logs[1].data, logs[1].metadata.replace(**{field: other}))
    mine = Rollout(logs[1].data, logs[1].metadata.replace(servo="xm430-w350"))
    with pytest.raises(LogError, match=r"different (robots|kinds of robots|servos)"):
        diagnosed_mount([mine, stranger])


def test_models_are_compared_on_the_other_mounts(logs):
    """The model that made the floor's logs leaves next to nothing there, another one more, in gap and loss."""
    right = load_model("paper")
    wrong = right.with_values({"coulomb_friction": 0.3})
    told = on_other_mounts(wrong, right, {"floor": logs[::2]})["floor"]
    assert told["logs"] == 2
    assert told["gap"]["joint/position"]["after"] < 0.5 * told["gap"]["joint/position"]["before"]
    assert told["gap"]["joint/position"]["floor"] == 0.0  # the same log twice
    assert told["loss"]["after"] < told["loss"]["before"]


def test_logs_in_which_nothing_moves_are_told_so():
    """A robot that stands still on its stand gets a sentence on what to record, and no finding."""
    model = load_model("paper")
    still = simulate_motion(model, chirp({"l_knee": 1e-4}, duration=4.0, robot="op3"), mount="stand")
    part = LogSplit((still,), (still,))
    verdict = Diagnosis(model, part).run()
    assert not verdict.findings
    assert "No joint moves" in verdict.sentence
