"""Open-loop replay of logs."""

import numpy as np
import pytest
import torch

from op3.motions import squat
from op3.replay import Replay, simulate_motion
from op3.rollout import LogError, Metadata, Rollout, read_log
from op3.servo import RobotModel
from op3.servo.effects import Coulomb, EncoderOffset, Motor, PositionServo
from op3.sim import load_model
from tests.op3_table import JOINTS, LIMBS

SHORT = squat(duration=0.6)


@pytest.fixture(scope="module")
def logs() -> list[Rollout]:
    model = load_model("paper")
    return [simulate_motion(model, SHORT, mount=mount) for mount in ("stand", "floor")]


def test_a_log_of_the_model_itself_is_reproduced(logs):
    """Replaying what the model made leaves only the error of the starting state, on the floor and in the stand."""
    for prediction in Replay(logs).run(load_model("paper")):
        error = prediction.channels[("joint", "position")][0] - torch.from_numpy(prediction.log.array("joint/position"))
        assert error.abs().max() < 2e-3
        assert not prediction.failed.any()


def test_every_candidate_has_its_own_parameters(logs):
    """Candidates differ, each as if it had been alone."""
    model = load_model("paper")
    constants = torch.tensor([0.005, 0.007], dtype=torch.float64)
    both = Replay(logs[1:]).run(model, {"torque_constant": constants}, 2)[0].channels[("joint", "current")]
    alone = Replay(logs[1:]).run(model.with_values({"torque_constant": 0.007}))[0].channels[("joint", "current")]
    assert not torch.allclose(both[0], both[1], atol=1e-3)
    torch.testing.assert_close(both[1], alone[0], atol=1e-12, rtol=0)


def test_replay_can_be_shortened(logs):
    """With a duration only the first rows are predicted, and less is simulated."""
    replay = Replay(logs, duration=0.2)
    assert replay.seconds < Replay(logs).seconds
    assert replay.run(load_model("paper"))[0].channels[("joint", "position")].shape[1] == 26


def test_foreign_joints_are_refused(logs):
    """A log of another robot is named."""
    stranger = Rollout(logs[0].data, logs[0].metadata.replace(joints=tuple(reversed(logs[0].joints))))
    with pytest.raises(LogError, match="joints"):
        Replay([stranger]).run(load_model("paper"))


def changed(log: Rollout, **arrays) -> Rollout:
    """A log with other channels by name (`time`, `p_gain`); None takes one away."""
    keys = {"time": "time", "p_gain": ("command", "p_gain")}
    data = {key: log.data[key] for key in log.channels}
    for name, values in arrays.items():
        data.pop(keys[name])
        if values is not None:
            data[keys[name]] = values
    return Rollout.from_arrays(data, log.metadata)


def test_a_jittering_clock_costs_no_latency(logs):
    """Stamps that are up to 2 ms off leave every command on its tick."""
    time = logs[0].array("time")[:, 0]
    jitter = np.random.default_rng(0).uniform(0, 0.002, len(time))
    jitter[0] = 0.0
    exact = Replay(logs[:1]).run(load_model("paper"))[0].channels[("joint", "velocity")]
    jittered = Replay([changed(logs[0], time=time + jitter)]).run(load_model("paper"))[0]
    moved = np.abs(logs[0].array("joint/velocity")).max()
    # the prediction is read at the jittered times, so it differs by what the joints move in 2 ms, and no more
    assert (jittered.channels[("joint", "velocity")] - exact).abs().max() < 0.2 * moved


def test_a_log_without_gains_is_refused_by_name(logs):
    """One log that lacks what the servos need is named, and does not change how the others are replayed."""
    with pytest.raises(LogError, match="command/p_gain"):
        Replay([logs[0], changed(logs[0], p_gain=None)]).run(load_model("paper"))


def test_gains_may_stand_in_the_metadata(tmp_path):
    """A table of one's own has targets and angles, and says once what the gains were."""
    (tmp_path / "run.csv").write_text("time,l_knee.target,l_knee.position\n0,0.2,0.1\n0.008,0.2,0.1\n0.016,0.2,0.1\n")
    about = "joints: [l_knee]\nrobot: real\nmount: stand\nrate: 125\n"
    (tmp_path / "run.yaml").write_text(about + "p_gain: 4\nd_gain: 0.1\n")
    assert (read_log(tmp_path / "run.csv").array("command/p_gain") == 4).all()
    (tmp_path / "run.yaml").write_text(about)
    assert ("command", "p_gain") not in read_log(tmp_path / "run.csv")


def test_the_battery_of_the_metadata_reaches_the_servos(logs):
    """Without a voltage channel the battery of the log counts, then the model's."""
    low = Rollout(logs[1].data, logs[1].metadata.replace(battery=3.0))
    full, starved = (Replay([log]).run(load_model("paper"))[0].channels[("joint", "current")] for log in (logs[1], low))
    assert starved.abs().max() < full.abs().max()


def test_a_tilted_stand_is_simulated_tilted(logs):
    """The stand's tilt is read from the log's orientation, so gravity pulls the arms as it did."""
    orientation = np.zeros((len(logs[0]), 3))
    orientation[:, 1] = 0.5
    data = {key: logs[0].data[key] for key in logs[0].channels} | {("imu", "orientation"): orientation}
    tilted = Rollout.from_arrays(data, logs[0].metadata)
    level, leaning = (Replay([log]).run(load_model("paper"))[0] for log in (logs[0], tilted))
    assert leaning.channels[("imu", "orientation")][0, -1, 1] == pytest.approx(0.5, abs=1e-6)
    assert not torch.allclose(level.channels[("joint", "current")], leaning.channels[("joint", "current")], atol=1e-3)


def bench_model() -> RobotModel:
    effects = (PositionServo(), Motor(gear_ratio=1.0, drive="voltage"), Coulomb(), EncoderOffset())
    return RobotModel(effects).with_values(
        {
            "torque_constant": 0.5,
            "terminal_resistance": 4.0,
            "armature": 0.001,
            "coulomb_friction": 0.005,
            "encoder_offset": -0.1,
        }
    )


def swung(model: RobotModel, mass: float, length: float) -> Rollout:
    """A pendulum whose goal swings for a second."""
    time = np.arange(1000) * 0.001
    goal = np.sin(4 * time)[:, None]
    facts = Metadata(joints=("servo",), robot="simulated", mount="pendulum", rate=1000.0, mass=mass, length=length)
    commands = {"time": time, "command/position": goal, "command/firmware_gain": np.full_like(goal, 16.0)}
    asked = Rollout.from_arrays({**commands, "joint/position": goal}, facts)
    position = Replay([asked], settle=0.0).run(model)[0].channels["joint", "position"][0]
    return Rollout.from_arrays({**commands, "joint/position": position}, facts)


def test_pendulums_of_one_batch_move_as_each_alone():
    """Pendulums of different mass and length are replayed side by side as one by one."""
    model = bench_model()
    logs = [swung(model, mass, length) for mass, length in ((0.2, 0.05), (0.45, 0.1))]
    for log, prediction in zip(logs, Replay(logs, settle=0.0).run(model), strict=True):
        error = prediction.channels[("joint", "position")][0] - torch.from_numpy(log.array("joint/position"))
        assert error.abs().max() < 1e-3
    assert np.ptp(logs[1].array("joint/position")) > 0.5


def test_values_under_a_condition_reach_their_logs():
    """Each log has the value of its own length, whether the model holds it or a candidate brings it."""
    model, name = bench_model(), "encoder_offset@length=1e-1"
    logs = [swung(model, 0.3, length) for length in (0.05, 0.1)]
    replay = Replay(logs, settle=0.0, duration=0.3)

    def positions(model, parameters=None):
        predictions = replay.run(model, parameters, 1 if parameters is None else 2)
        return [prediction.channels[("joint", "position")] for prediction in predictions]

    shared, moved = positions(model), positions(model.with_values({"encoder_offset": -0.05}))
    held = positions(model.with_values({name: -0.05}))
    torch.testing.assert_close(held[0], shared[0], atol=0, rtol=0)
    torch.testing.assert_close(held[1], moved[1], atol=0, rtol=0)
    assert not torch.allclose(moved[1], shared[1], atol=1e-3)
    given = positions(model, {name: torch.tensor([-0.05, -0.1], dtype=torch.float64)})
    torch.testing.assert_close(given[1], torch.cat([moved[1], shared[1]]), atol=0, rtol=0)
    torch.testing.assert_close(given[0], torch.cat([shared[0], shared[0]]), atol=0, rtol=0)


def test_values_of_single_joints_reach_them(logs):
    """A candidate's value for one joint does what the same value in the model does; others keep theirs."""
    model, name = load_model("paper"), "coulomb_friction@joint=l_knee"
    replay = Replay(logs[1:], duration=0.3)
    held = replay.run(model.with_values({name: 0.2}))[0].channels[("joint", "position")]
    given = replay.run(model, {name: torch.tensor([0.2, 0.05], dtype=torch.float64)}, 2)[0]
    torch.testing.assert_close(given.channels[("joint", "position")][:1], held, atol=0, rtol=0)
    assert not torch.allclose(given.channels[("joint", "position")][1:], held, atol=1e-4)
    with pytest.raises(ValueError, match="unknown joint 'l_kne'"):
        replay.run(model, {"coulomb_friction@joint=l_kne": torch.tensor([0.2])}, 1)


def test_longer_steps_of_a_bench_agree():
    """With 2 ms steps the replay differs by less than a milliradian on average."""
    log = swung(bench_model(), 0.3, 0.07)
    fine, coarse = (
        Replay([log], settle=0.0, bench_timestep=step).run(bench_model())[0].channels[("joint", "position")]
        for step in (0.001, 0.002)
    )
    assert 0 < (fine - coarse).abs().mean() < 1e-3


def test_a_leg_alone_moves_as_on_the_whole_robot(logs):
    """With a fixed trunk the other limbs are not felt: a log of one leg gives the same numbers, in fewer joints."""
    leg = LIMBS[-1]
    columns = [JOINTS.index(joint) for joint in leg]
    arrays = {
        k: logs[0].array(k)[:, columns] if k[0] in ("joint", "command") else logs[0].array(k) for k in logs[0].channels
    }
    alone = Rollout.from_arrays(arrays, logs[0].metadata.replace(joints=leg))
    both = Replay([alone, logs[0]]).run(load_model("paper"))
    for key in (("joint", "position"), ("joint", "current")):
        one, whole = (prediction.channels[key][0] for prediction in both)
        torch.testing.assert_close(one, whole[:, columns], atol=1e-9, rtol=0)


def test_a_push_turns_the_joint_that_it_acts_on(logs):
    """A torque beside the servo's moves its joint in its direction; none at all changes no bit."""
    knee = JOINTS.index("l_knee")
    pushed = np.zeros((len(logs[0]), len(JOINTS)))
    replay = Replay(logs[:1])
    free, still = (replay.run(load_model("paper"), push=push)[0] for push in (None, [pushed]))
    assert torch.equal(free.channels["joint", "position"], still.channels["joint", "position"])
    pushed[:, knee] = 1.5
    moved = (
        replay.run(load_model("paper"), push=[pushed])[0].channels["joint", "position"]
        - free.channels["joint", "position"]
    )
    assert moved[0, -1, knee] > 0.02
    assert moved[0, -1, knee] == moved[0, -1].abs().max()


def test_logs_of_nearly_one_rate_are_simulated_together(logs):
    """Recorders tell the rate that they measured: on a bench it never matters, on a robot two percent do not."""
    model = bench_model()
    bench = [swung(model, 0.3, length) for length in (0.05, 0.1)]
    uneven = [
        Rollout(log.data, log.metadata.replace(rate=rate)) for log, rate in zip(bench, (189.3, 190.7), strict=True)
    ]
    assert len(Replay(uneven)._groups) == 1
    robot = [Rollout(logs[0].data, logs[0].metadata.replace(rate=rate)) for rate in (124.4, 125.6, 62.5)]
    assert [len(group.logs) for group in Replay(robot)._groups] == [2, 1]
