"""What a user should get for each of the shared inputs that once failed, one row a case."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from op3.apps import import_log
from op3.apps.collect import collect
from op3.apps.compose import configured
from op3.apps.identify import identify
from op3.deploy import FollowPolicy, Limits, Plan, PolicyRunner, connect, run
from op3.deploy.exit_codes import ExitCode
from op3.policy import PolicyBundle
from op3.rollout import LogError, read_logs

ROOT = Path(__file__).resolve().parents[2]
INPUTS = ROOT.parent / "shared" / "cases" / "inputs"

pytestmark = pytest.mark.skipif(not INPUTS.is_dir(), reason=f"the shared cases are not in {INPUTS}")

ARM = {"shoulder_pan": 0.350, "shoulder_lift": 0.359, "elbow_flex": 0.314, "wrist_flex": 0.310, "wrist_roll": 0.468}
"""How far the joints move [rad] in the recording of which most of these logs are edits."""


@dataclass(frozen=True)
class Import:
    """A log, and what `op3 import` should give.

    Attributes:
        name: of the case.
        file: in its folder; empty for the folder.
        spans: how far each joint moves [rad]; empty where the log is refused.
        says: what is printed, in part.
        silent: whether the checks find nothing.
        seconds: duration of the log.
        robot: the `robot=` of the command.
    """

    name: str
    file: str = ""
    spans: dict[str, float] = field(default_factory=dict)
    says: tuple[str, ...] = ()
    silent: bool = False
    seconds: float = 7.99
    robot: str | None = None


LIMP = ("joint: l_knee\n", "channel: position\n")
KNEE = {"l_knee": 0.914, "r_knee": 0.914}
VARIANT = ("this must be another variant of the sts3215",)
IMPORTS = [
    Import(
        "bench_supply_12",
        "run.json",
        {"servo": 1.559},
        ("the supply is 12 V, but the servo file sts3215", *VARIANT),
        seconds=5.99,
    ),
    Import(
        "bench_supply_24",
        "run.json",
        {"servo": 1.559},
        ("the supply is 24 V, but the servo file sts3215", *VARIANT),
        seconds=5.99,
    ),
    Import("csv_computed_velocity", "run.csv", {"servo": 0.58}, ("joints servo\n", "joint/velocity"), silent=True),
    Import("csv_counts_by_id", "run.csv", ARM, silent=True, robot="arm"),
    Import("csv_dynamixel_wizard", "run.csv", says=("write `unit: counts of 0.229 rpm` for it under `columns:`",)),
    Import("csv_gripper_percent", "run.csv", says=("looks like percent of a gripper's opening", "as `unit:` of")),
    Import("csv_negative_velocity_scaled", "run.csv", ARM, ("negative velocities are 0.82 times", "(also in ")),
    Import("csv_plotjuggler", "run.csv", ARM, silent=True),
    Import("csv_rostopic_echo_p", "run.csv", says=("shoulder_pan.position", "shoulder_pan.target: the required")),
    Import("csv_union_of_stamps", "run.csv", ARM, silent=True),
    Import("csv_xl320_counts", "run.csv", ARM, ("# doubtful:", "1024 counts in 300 degrees, such as XL-320")),
    Import(
        "lerobot_bimanual_normalised",
        spans={
            f"{side}_{name}": span for side in ("left", "right") for name, span in {**ARM, "gripper": 0.025}.items()
        },
        says=(
            "the gain 16, which LeRobot writes to the servos of",
            "every value equals that of left_shoulder_pan.position",
        ),
        seconds=7.97,
    ),
    Import("lerobot_degrees_with_calibration", "", {**ARM, "gripper": 0.025}, ("unit: deg",), True, 7.97),
    Import(
        "lerobot_degrees_with_calibration_large",
        spans={**{name: 5 * span for name, span in ARM.items()}, "gripper": 0.129},
        says=("unit: deg", "encoder counts"),
        silent=True,
        seconds=7.97,
    ),
    Import("lerobot_old_calibration", "", ARM, ("deg: the calibration states it",), True, 7.97),
    Import("npz_sysid_torque", "run.npz", says=("like a torque", "name the command <joint>.load")),
    Import("op3_knee_limp", "run.csv", KNEE, (*LIMP, "the servo had no torque"), seconds=4.99),
    Import("op3_knee_limp_current_velocity", "run.csv", KNEE, (*LIMP, "its torque was off"), seconds=4.99),
    Import(
        "op3_right_side_mirrored",
        "run.csv",
        KNEE,
        ("joint: r_knee\n", "with reversed sign", "r_sho_pitch, r_sho_roll, r_el, r_hip_pitch", "close to 0"),
        seconds=4.99,
    ),
    Import("ros_leader_follower", "", ARM, silent=True),
    Import("ros_sim_time_half_speed", "", ARM, silent=True),
    Import("ros_sim_time_half_speed_vel", "", ARM, ("joint/velocity",), silent=True),
    Import("ros_trajectory_single_points", "", {"shoulder_pan": 0.347, "wrist_roll": 0.445}, silent=True),
    Import("ros_two_publishers_zero", "", ARM, ("publishes zeros; its messages are ignored",), silent=True),
]


@pytest.mark.parametrize("case", IMPORTS, ids=lambda case: case.name)
def test_a_log_is_read_rightly_or_explained(case, tmp_path, capsys):
    """Units, signs, times and joints are right without a word, or what is wrong is said."""
    shutil.copytree(INPUTS / case.name, tmp_path / case.name, copy_function=shutil.copyfile)
    (tmp_path / case.name).chmod(0o755)
    log = tmp_path / case.name / case.file
    with configured("import_log", data=str(log), robot=case.robot) as cfg:
        if case.spans:
            import_log.main(cfg)
        else:
            with pytest.raises(SystemExit, match="1"):
                import_log.main(cfg)
    printed = capsys.readouterr().out
    assert [part for part in case.says if part not in printed] == []
    assert ("the checks found nothing wrong" in printed) == (case.silent or "1024" in "".join(case.says))
    if not case.spans:
        with pytest.raises(LogError):
            read_logs(log)
        return
    (read,) = read_logs(log)
    angle, target = read.array("joint/position"), read.array("command/position")
    moved = dict(zip(read.joints, np.ptp(angle, axis=0).tolist(), strict=True))
    assert {name: moved[name] for name in case.spans} == pytest.approx(case.spans, rel=0.02, abs=0.005)
    assert read.duration == pytest.approx(case.seconds, abs=0.02)
    if case.silent:  # a servo comes after its command by some hundredths of a second
        joint = int(np.ptp(target, axis=0).argmax())
        lags = range(-20, 40)
        off = [np.abs(angle[20:-40, joint] - np.roll(target[:, joint], n)[20:-40]).mean() for n in lags]
        assert 0 <= lags[int(np.argmin(off))] / read.metadata.rate < 0.1


@pytest.mark.parametrize(
    ("name", "log_rows"), [("op3_knee_limp", (1.6, 2.65)), ("op3_knee_limp_current_velocity", (1.6, 2.65))]
)
def test_all_the_time_that_a_knee_hangs_is_named(name, log_rows):
    """So that leaving it out leaves a sound log."""
    (read,) = read_logs(INPUTS / name / "run.csv")
    (found,) = read.findings
    assert found.times is not None
    assert max(found.times[0], log_rows[0]) < log_rows[0] + 0.3
    assert log_rows[1] - 0.2 < found.times[1] < log_rows[1] + 0.3


@pytest.mark.parametrize(
    ("model", "more", "says"),
    [
        ("mjcf_passive_hinge/m.yaml", "", "list it with its servo, or as `tail: {passive: true}`"),
        ("mjcf_passive_hinge/m.yaml", "  tail: {passive: true}\n", ""),
        ("mjcf_slide/m.yaml", "", "omit the model's joint 'finger'"),
        ("mjcf_slide/m_listed.yaml", "", "write `travel: <m/rad>` if a servo moves it as a slide"),
        ("mjcf_slide/m.yaml", "  finger: {bus_id: 2, travel: 0.01, home: 1.0}\n", ""),
        ("mjcf_plain/m.yaml", "", ""),
        ("urdf_continuous/arm.yaml", "", ""),
        ("urdf_effort_limit/arm_0.05.yaml", "", ""),
        ("urdf_mimic/arm.yaml", "", "coupling of finger_mimic to finger: ignored: the joint has its own servo"),
        ("urdf_package_path/arm.yaml", "", ""),
    ],
)
@pytest.mark.parametrize("source", ["model", "stand_in"])
def test_a_robot_is_recorded_or_explained(model, more, says, source, tmp_path, caplog):
    """With joints that follow their commands, whatever the file says of efforts."""
    shutil.copytree(INPUTS / Path(model).parent, tmp_path / "robot", copy_function=shutil.copyfile)
    file = tmp_path / "robot" / Path(model).name
    file.write_text(file.read_text().rstrip() + "\n" + more)
    arguments = dict(source=source, robot=file, mount="stand", overrides=["motion.duration=2"])
    if says and "ignored" not in says:
        with pytest.raises(ValueError, match=re.escape(says)):
            collect("multisine", **arguments)
        return
    (log,) = collect("multisine", **arguments).logs
    assert not says or says in caplog.text
    assert (np.ptp(log.array("joint/position"), axis=0) > 0.7 * np.ptp(log.array("command/position"), axis=0)).all()


def test_a_mimicking_joint_needs_no_servo(tmp_path):
    """It follows by the file's own ratio, and the log has the joints with servos."""
    shutil.copytree(INPUTS / "urdf_mimic", tmp_path / "robot", copy_function=shutil.copyfile)
    file = tmp_path / "robot" / "arm.yaml"
    file.write_text(file.read_text().replace("  finger_mimic: {bus_id: 4}\n", ""))
    (log,) = collect("multisine", source="stand_in", robot=file, mount="stand", overrides=["motion.duration=2"]).logs
    assert log.joints == ("shoulder", "elbow", "finger")


def recorded(names: Sequence[str], folder: Path) -> list[tuple[Path, ...]]:
    """Recordings of two seconds of these robots."""
    more = dict(source="stand_in", mount="stand", overrides=["motion.duration=2"])
    return [
        collect("multisine", robot=INPUTS / name, folder=folder / str(i), **more).folders
        for i, name in enumerate(names)
    ]


def test_another_robots_study_is_refused(tmp_path):
    """The same folder with logs of another robot names what differs."""
    first, other = recorded(["mjcf_plain/m.yaml", "urdf_continuous/arm.yaml"], tmp_path)
    settings = dict(method="tpe", groups=["friction"], ablate=[], trials=2, folder=tmp_path / "found")
    identify(first, **settings, overrides=["refine.rounds=0"])
    with pytest.raises(Exception, match="has other logs, robot than this run: choose another folder"):
        identify(other, **settings, overrides=["refine.rounds=0"])


def test_a_servo_switched_off_by_another_program_ends_the_run(tmp_path, monkeypatch):
    """With an exit code of its own, and its name."""
    monkeypatch.chdir(ROOT)
    robot = connect("emulated", robot="op3", mount="stand", confirm=False, model="paper")
    robot.emulated.at(7.0, lambda: robot.emulated.servos["l_knee"].write(64, bytes([0])))
    runner = PolicyRunner(PolicyBundle.load("assets/policies/walk"), robot="op3")
    try:
        ended = run(
            robot,
            lambda: FollowPolicy(runner, 4.0),
            Plan(Limits(), folder=tmp_path, panel=False),
            motion="walk",
            policy_rate=31.25,
            git_hash="x",
        )
    finally:
        robot.close()
    assert ended.code == ExitCode.TORQUE_LOST
    assert "l_knee" in ended.reason
