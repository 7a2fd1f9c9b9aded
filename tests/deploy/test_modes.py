"""What a user does with a robot on a port: run, dry run, read only, setup, calibrate, recordings."""

import io
import time
from pathlib import Path

import numpy as np
import pytest
from deploy_rig import make_rig
from policies import hold_policy

from op3.deploy import Calibration, Connection, Plan, Player, calibrate, connect, read_only, run, setup
from op3.deploy.dynamixel_bus import Unplugged
from op3.deploy.emulator import USUAL_SETTINGS
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Command
from op3.deploy.monitors import MonitorResult
from op3.deploy.operator import Operator
from op3.deploy.panel import StatusPanel
from op3.deploy.phases import FollowMotion
from op3.deploy.policy_runner import FollowPolicy, PolicyRunner
from op3.deploy.protocol import Instruction
from op3.deploy.ticker import Ticker
from op3.motions import Motion, squat
from op3.robot import pose
from op3.rollout import Rollout
from tests.op3_table import JOINTS, OP3
from tests.scripts import run_script

ROOT = Path(__file__).resolve().parents[2]


def connected(rig):
    return Connection(rig.bus, Operator(), "emulated", "stand", {"world": "none"}, 0)


def test_a_whole_run(tmp_path):
    """Approach, run and what comes after are three logs that identification reads; metadata tells how it went."""
    rig = make_rig(tmp_path)
    motion = squat(duration=1.0)
    outcome = run(
        connected(rig),
        lambda: FollowMotion(motion),
        Plan(folder=tmp_path / "logs", end_pose="squat_low"),
        start=motion.position[0],
        recording="squat-0",
        motion="squat",
        report=rig.lines.append,
    )
    assert outcome.code == ExitCode.OK
    assert set(outcome.logs) == {"approach", "run", "after"}
    log = Rollout.load(tmp_path / "logs" / "run").check()
    assert log.rows == 125
    assert np.array_equal(log.array("command/position"), motion.position)
    metadata = log.metadata
    assert (metadata.robot, metadata.mount, metadata.motion, metadata.rate) == ("emulated", "stand", "squat", 125.0)
    assert metadata.recording == "squat-0/run"
    assert metadata.extra["exit"] == "ok"
    assert metadata.extra["missed_ticks"] == 0
    assert metadata.extra["lateness_p99"] <= metadata.extra["lateness_max"] < 0.008
    raw = log.array("raw/position")
    assert np.allclose((raw - 2048) * 2 * np.pi / 4096, log.array("joint/position"))
    assert np.allclose(log.array("raw/current") * 0.00269, log.array("joint/current"))
    goals = [values["l_knee"] for _, values in rig.written("goal_current")]
    logged = log.array("raw/goal_current")[:, JOINTS.index("l_knee")].tolist()
    first = next(i for i in range(len(goals)) if goals[i : i + len(logged)] == logged)
    assert first > 0
    assert np.allclose(
        Rollout.load(tmp_path / "logs" / "after").array("command/position")[-1], pose("squat_low", "op3")
    )


def test_dry_run(tmp_path):
    """All of the loop and the policy, and not one torque enable or goal current on the wire."""
    rig = make_rig(tmp_path)
    runner = PolicyRunner(hold_policy(feedback=0.2), robot="op3")
    plan = Plan(dry=True, folder=tmp_path / "logs")
    outcome = run(connected(rig), lambda: FollowPolicy(runner, 1.0), plan, report=rig.lines.append)
    assert outcome.code == ExitCode.OK
    assert rig.written("torque_enable") == []
    assert rig.written("goal_current") == []
    log = outcome.logs["run"]
    assert (log.array("command/torque_enable") == 0).all()
    assert np.abs(log.array("policy/action")).max() > 0


def test_read_only_writes_nothing(tmp_path):
    """Not one write instruction leaves the computer; the log holds what the robot said."""
    rig = make_rig(tmp_path)
    rig.robot.switch_on()
    outcome = read_only(connected(rig), 0.5, Plan(folder=tmp_path / "logs"), report=rig.lines.append)
    assert outcome.code == ExitCode.OK
    sent = {packet.instruction for _, packet in rig.packets()}
    assert sent <= {Instruction.PING, Instruction.READ, Instruction.SYNC_READ}
    log = outcome.logs["run"]
    assert log.rows == 62
    assert np.allclose(log.array("joint/position"), pose("stand", "op3"), atol=1e-3)
    assert np.allclose(log.array("joint/voltage"), 12.0)


def test_setup_makes_a_factory_robot_start(tmp_path):
    """A robot with the factory's return delay fails the start checks, and passes them after setup."""
    rig = make_rig(tmp_path, settings={**USUAL_SETTINGS, "return_delay_time": 250, "drive_mode": 1})
    assert setup(connected(rig), report=rig.lines.append) == ExitCode.OK
    assert rig.register("return_delay_time") == [0] * 20
    assert rig.register("drive_mode") == [0] * 20
    assert rig.written("goal_current") == []
    rig.bus._writer = None
    assert rig.run(duration=0.1).code == ExitCode.OK


def test_calibrate(tmp_path):
    """The robot is held in the zero pose with servos that are off by up to 0.1 rad; afterwards angles read zero."""
    off = np.linspace(-0.1, 0.1, 20)
    rig = make_rig(tmp_path, position=off)
    rig.robot.switch_on()
    path = tmp_path / "calibration.yaml"
    assert calibrate(connected(rig), path, report=rig.lines.append) == ExitCode.OK
    rig.bus.calibration = Calibration.load(path, "op3")
    assert np.abs(rig.bus.read_state().position).max() < 1e-3
    assert not {packet.instruction for _, packet in rig.packets()} & {Instruction.WRITE, Instruction.SYNC_WRITE}


def test_a_jig_holds_the_emulated_robot_in_any_pose(tmp_path):
    """Without torque bent knees would give way: held, its zeros are within the offsets that are accepted."""
    held = {"joint_position": pose("stand", "op3"), "powered": True, "jig": True}
    connection = connect("emulated", mount="stand", robot="op3", **held)
    assert calibrate(connection, tmp_path / "c.yaml", pose_name="stand", report=lambda line: None) == ExitCode.OK
    assert np.abs(Calibration.load(tmp_path / "c.yaml", "op3").offset).max() < 0.1


def test_calibrate_refuses_a_robot_with_torque(tmp_path):
    """A pose that servos hold themselves says nothing about it."""
    rig = make_rig(tmp_path)
    rig.robot.switch_on()
    rig.robot.servos["l_knee"].put("torque_enable", 1)
    assert calibrate(connected(rig), tmp_path / "c.yaml", report=rig.lines.append) == ExitCode.START_CHECK
    assert "torque is on at l_knee" in rig.lines[-1]
    assert not (tmp_path / "c.yaml").exists()


def test_a_motion_out_of_bounds_is_refused_before_anything():
    """A target beyond a soft limit names joint, time and range."""
    motion = Motion(np.array([0.0, 0.008]), np.array([[0.0], [3.0]]), ("l_knee",), "kick", robot="op3")
    with pytest.raises(
        ValueError, match=r"'kick' commands l_knee to 3.000 rad at 0.008 s; its limits are -0.314 and 2.199"
    ):
        FollowMotion(motion)


def test_a_port_that_is_not_there():
    """The device that cannot be opened is named."""
    with pytest.raises(Unplugged, match=r"NOWHERE cannot be opened \(No such file or directory\); plug"):
        connect("/dev/ttyNOWHERE", robot="op3")
    with pytest.raises(ValueError, match="mount must be floor or stand"):
        connect("/dev/ttyNOWHERE", mount="ceiling", robot="op3")


class Window(io.StringIO):
    """A terminal of 80 columns and 24 rows that keeps what was written, some time later."""

    delay = 0.0

    def isatty(self):
        return True

    def write(self, text):
        time.sleep(self.delay)
        return super().write(text)


def shown(panel, rig, times):
    """Ticks in the panel, each after what was shown before is written."""
    state, ticker = rig.bus.read_state(), Ticker(rig.robot.clock)
    ticker.wait()
    for _ in range(times):
        panel(
            "hold",
            state,
            Command.of(pose("stand", "op3"), 5.0, 0.1),
            np.zeros(20),
            MonitorResult(note="all odd"),
            ticker,
        )
        deadline = time.monotonic() + 10
        while not (panel._waiting.empty() or panel._stream.delay or time.monotonic() > deadline):
            time.sleep(0.01)


def test_what_is_said_stays_above_the_panel(tmp_path):
    """One line per joint, rewritten in place; a question stays, and the next block begins below it, in 80 columns."""
    rig, window, file = make_rig(tmp_path), Window(), io.StringIO()
    rig.robot.switch_on()
    silent, panel = StatusPanel(OP3, stream=file, every=2), StatusPanel(OP3, stream=window, every=2)
    shown(silent, rig, 3)
    assert file.getvalue() == ""  # no terminal
    panel.say("before")
    assert window.getvalue() == "before\n"
    shown(panel, rig, 3)
    panel.say("press Enter")
    shown(panel, rig, 2)
    panel.close()
    lines = window.getvalue().splitlines()
    at = lines.index("press Enter")
    assert sum("l_knee" in line for line in lines[:at]) == 2
    assert any(line.startswith("\x1b[23A") for line in lines[:at])
    assert not any("\x1b[23A" in line for line in lines[at : at + 23])
    assert len(lines[at + 1 :]) >= 23
    assert "all odd" in lines[-1]
    assert max(len(line.replace("\x1b[23A", "").replace("\x1b[2K", "")) for line in lines) < 80


def test_a_stalled_terminal_does_not_hold_up_the_loop(tmp_path):
    """A terminal that takes no more text costs the loop nothing but the text."""
    rig, window = make_rig(tmp_path), Window()
    window.delay = 5.0
    rig.robot.switch_on()
    before = time.monotonic()
    shown(StatusPanel(OP3, stream=window, every=2), rig, 20)
    assert time.monotonic() - before < 2.0


@pytest.mark.parametrize("options", [{"world": "default"}, {"model": "paper"}], ids=["stand-in", "model"])
def test_recording_on_the_emulated_robot(tmp_path, options):
    """Held in the air, put down, and recorded standing on the floor: it begins at rest and upright, with the gains."""
    player = Player(
        "emulated", "floor", folder=tmp_path / "ticks", seed=2, report=lambda line: None, robot="op3", **options
    )
    motion = squat(duration=0.4)
    log = player.play(motion, 5.0, 0.1, recording="squat-0").check()
    assert (log.metadata.robot, log.metadata.recording, log.metadata.seed) == ("emulated", "squat-0", 2)
    assert (log.array("command/p_gain") == 5).all()
    assert np.abs(log.array("imu/orientation")[:, :2]).max() < 0.4
    assert np.abs(log.array("joint/velocity")[0]).max() < 0.1
    assert np.abs(log.array("joint/position")[0] - motion.position[0]).max() < 0.15
    assert "backward" not in log.metadata.to_yaml()


def test_a_run_that_ends_early_is_not_a_recording(tmp_path):
    """The player raises the reason, with its exit code; the ticks are kept."""
    player = Player(
        "emulated",
        "stand",
        folder=tmp_path,
        report=lambda line: None,
        settings={**USUAL_SETTINGS, "return_delay_time": 9},
        robot="op3",
    )
    with pytest.raises(Stop, match="return delay") as stop:
        player.play(squat(duration=0.1))
    assert stop.value.code == ExitCode.START_CHECK


def test_deploy_script_and_replay(tmp_path):
    """A policy on the emulated robot from the command line ends with 0, and its log replays to the same actions."""
    bundle = hold_policy(feedback=0.1).save(tmp_path / "bundle")
    common = (f"policy={bundle}", "panel=false")
    refused = run_script("deploy.py", *common, "port=emulated", f"hydra.run.dir={tmp_path / 'refused'}")
    assert refused.returncode == ExitCode.START_CHECK
    assert f"FAIL policy card: {bundle} has no card" in refused.stdout
    assert refused.stdout.rstrip().endswith("to run the policy anyway, set card=ignore")
    common = (*common, "card=ignore")
    result = run_script(
        "deploy.py", *common, "port=emulated", "duration=0.5", "mount=stand", f"hydra.run.dir={tmp_path / 'run'}"
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "torque off verified 20/20" in result.stdout
    log = tmp_path / "run" / "run"
    assert str(log) in result.stdout
    again = run_script("deploy.py", *common, "mode=replay", f"log={log}", f"hydra.run.dir={tmp_path / 'replay'}")
    assert again.returncode == 0, again.stdout + again.stderr
    assert "the same actions" in again.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("duration=nan", "limits.peak_current=oops"), 1, "duration must be a finite number, got nan"),
        (("port=/dev/ttyNOWHERE",), 12, "cannot be opened"),
    ],
)
def test_wrong_arguments(tmp_path, arguments, code, message):
    """One sentence and a non-zero exit; a port that cannot be opened has its own code."""
    result = run_script("deploy.py", *arguments, f"hydra.run.dir={tmp_path}")
    assert result.returncode == code
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_a_log_is_not_written_over(tmp_path):
    """A folder that holds a run is refused before the port is opened, and stays as it is."""
    (tmp_path / "run").mkdir()
    result = run_script("deploy.py", "port=/dev/ttyNOWHERE", f"hydra.run.dir={tmp_path}")
    assert result.returncode == 1
    assert "run already exists, and a log is never overwritten; choose another hydra.run.dir" in result.stderr
    assert list((tmp_path / "run").iterdir()) == []


def test_collect_from_the_emulated_robot(tmp_path):
    """`collect source=emulated` leaves the same folders as the stand-in; a policy records its episodes."""
    bundle = hold_policy().save(tmp_path / "steady")
    out = tmp_path / "out"
    result = run_script(
        *("collect.py", "source=emulated", f"policy={bundle}", "duration=0.3", "mount=stand"), f"hydra.run.dir={out}"
    )
    assert result.returncode == 0, result.stdout + result.stderr
    log = Rollout.load(out / "steady-0")
    assert log.metadata.policy_rate == 31.25
    assert log.metadata.motion == "balance"
    assert log.metadata.episode_duration == pytest.approx(0.28, abs=0.04)
    assert "policy/action" in log
