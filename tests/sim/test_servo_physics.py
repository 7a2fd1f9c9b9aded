"""The law between MuJoCo's steps, against closed forms and against MuJoCo's own DC motor."""

import mujoco
import numpy as np
import pytest
import torch

from op3.servo import RobotModel
from op3.servo.effects import (
    Coulomb,
    CurrentPD,
    DirectionalEfficiency,
    Motor,
    PositionServo,
    Stribeck,
    Viscous,
)
from op3.sim import BatchSimulation, attach_servos
from op3.sim.ports import ServoPorts

IDEAL = {"torque_constant": 0.006, "terminal_resistance": 5.0, "armature": 0.005}


def compiled(hinge, **kwargs) -> mujoco.MjModel:
    root, joint = hinge(**kwargs)
    attach_servos([joint])
    return mujoco.MjModel.from_xml_string(root.to_xml_string())


def simulation(mj_model, effects, values, num_sims=1, **kwargs) -> BatchSimulation:
    model = RobotModel(tuple(effects)).with_values(values)
    return BatchSimulation(mj_model, ["hinge"], model, num_sims, **kwargs)


def test_saturated_current_drive_is_mujocos_dcmotor(hinge, dc_motor):
    """A current that the bus cannot drive makes the servo a DC motor at bus voltage."""
    sim = simulation(compiled(hinge), [CurrentPD(current_limit=1e3), Motor()], IDEAL)
    ticks = 60
    sim.reset([0.0], {"p_gain": 1e4, "position_target": 1e3})
    ours = []
    for _ in range(ticks):
        sim.advance()
        ours.append(sim.signals.position.item())
    np.testing.assert_allclose(ours, dc_motor([11.1] * ticks, 8), atol=1e-6)


def test_voltage_drive_below_saturation_is_mujocos_dcmotor(hinge, dc_motor):
    """A voltage-driven servo equals MuJoCo's dcmotor fed with the same voltages."""
    effects = [PositionServo(error_gain=1.0, max_duty=1.0, goal_speed=1e9), Motor(drive="voltage")]
    sim = simulation(compiled(hinge), effects, IDEAL, control_period=0.001)
    sim.reset([0.0], {"firmware_gain": 0.4, "position_target": 0.5})
    ours, voltages = [], []
    for tick in range(500):
        sim.command(position_target=np.sin(0.01 * tick))
        sim.advance()
        ours.append(sim.signals.position.item())
        voltages.append(sim.signals.voltage.item())
    assert max(map(abs, voltages)) < 11.1
    np.testing.assert_allclose(ours, dc_motor(voltages, 1), atol=1e-6)


def test_current_drive_below_saturation_is_a_torque_source(hinge):
    """Unsaturated, ideal gear, no friction: the joint feels K I* and nothing else, as a plain motor gives it."""
    sim = simulation(compiled(hinge), [CurrentPD(), Motor()], IDEAL)
    plain_model = compiled(hinge)
    plain = mujoco.MjData(plain_model)
    sim.reset([0.0], {"p_gain": 1.0, "d_gain": 0.1})
    for _ in range(250):
        current = 1.0 * (0.4 - plain.qpos[0]) - 0.1 * plain.qvel[0]
        sim.command(position_target=0.4)
        sim.advance()
        plain.ctrl[0] = 0.006 * 353.5 * current
        for _ in range(8):
            mujoco.mj_step(plain_model, plain)
    assert sim.signals.position.item() == pytest.approx(plain.qpos[0], abs=1e-9)


def saturated_motion(hinge, timestep, resistance, gear, efficiency):
    """Positions of the pendulum thrown to and fro at bus voltage, ``[sim, tick]``."""
    values = {**IDEAL, "coulomb_friction": 0.05}
    effects = [CurrentPD(current_limit=1e3), Motor(), Coulomb()]
    if gear is not None:
        effects.append(DirectionalEfficiency(form=gear))
        values |= {"forward_efficiency": efficiency, "backward_efficiency": 0.7}
    sim = simulation(compiled(hinge, timestep=timestep), effects, values, num_sims=len(resistance))
    sim.set_parameters({"terminal_resistance": torch.as_tensor(resistance)})
    sim.reset([0.0], {"p_gain": 1e3})
    positions = []
    for tick in range(100):
        sim.command(position_target=3.0 if tick < 50 else -3.0)
        sim.advance()
        positions.append(sim.signals.position[:, 0].clone())
    return torch.stack(positions, 1)


@pytest.mark.parametrize(
    ("gear", "efficiency", "tolerance"),
    [(None, 1.0, 0.01), ("passive", 1.0, 0.01), ("printed", 0.8, 0.01), ("passive", 0.8, 0.02)],
)
def test_resistance_is_recovered_from_saturated_motion(hinge, gear, efficiency, tolerance):
    """R identified at 1 ms from voltage-saturated motion made at 0.05 ms is right within 1 %, 2 % with forward loss."""
    truth = saturated_motion(hinge, 0.00005, [5.0], gear, efficiency)
    candidates = np.linspace(4.7, 5.3, 61)
    error = ((saturated_motion(hinge, 0.001, candidates, gear, efficiency) - truth) ** 2).mean(1)
    assert candidates[error.argmin()] == pytest.approx(5.0, rel=tolerance)


def test_a_push_on_the_link_is_a_load_on_its_servo(hinge):
    """Held against half a newton metre, the servo feels and gives that much."""
    sim = simulation(compiled(hinge, gravity=False), [CurrentPD(), Motor()], IDEAL)
    sim.reset([0.0], {"p_gain": 6.0, "d_gain": 0.5})
    sim.push(np.array([[0.5]]))
    for _ in range(100):
        sim.advance()
    assert sim.signals.load_torque.item() == pytest.approx(0.5, rel=1e-3)
    assert sim.signals.motor_torque.item() == pytest.approx(-0.5, rel=1e-3)


def test_load_torque_of_two_links_solved_by_hand(hinge):
    """At rest the servo transmits what holds the link, m g l sin(q) plus the second link's, and bears the weight."""
    xml = """<mujoco><worldbody><body name="a"><inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-4 1e-4 1e-4"/>
      <joint name="upper" axis="0 1 0"/><body name="b" pos="0 0 -0.2">
      <inertial pos="0 0 -0.1" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/><joint name="lower" axis="0 -1 0"/>
      </body></body></worldbody></mujoco>"""
    from dm_control import mjcf

    root = mjcf.from_xml_string(xml)
    attach_servos([root.find("joint", "upper"), root.find("joint", "lower")])
    mj_model = mujoco.MjModel.from_xml_string(root.to_xml_string())
    data = mujoco.MjData(mj_model)
    upper, lower = 0.5, -0.3
    data.qpos[:] = [upper, lower]
    # gravity about the lower joint: 0.2 kg at 0.1 m, absolute angle upper - lower (its axis points back)
    gravity_lower = 0.2 * 9.81 * 0.1 * np.sin(upper - lower)
    gravity_upper = 0.3 * 9.81 * 0.1 * np.sin(upper) + 0.2 * 9.81 * 0.2 * np.sin(upper) + gravity_lower
    data.ctrl[:] = [gravity_upper, -gravity_lower]
    mujoco.mj_forward(mj_model, data)
    np.testing.assert_allclose(data.qacc, 0, atol=1e-9)
    ports = ServoPorts.find(mj_model, ["upper", "lower"])
    np.testing.assert_allclose(data.sensordata[ports.transmitted], [gravity_upper, -gravity_lower], atol=1e-9)
    radial = np.hypot(data.sensordata[ports.force], data.sensordata[ports.force + 1])
    np.testing.assert_allclose(radial, [0.5 * 9.81, 0.2 * 9.81], atol=1e-9)


def friction_effects():
    return [CurrentPD(), Motor(), DirectionalEfficiency(), Coulomb(), Stribeck(), Viscous()]


def test_friction_and_passive_gear_loss_never_add_energy(hinge):
    """10,000 random states: the power of friction is not positive unless the velocity reverses in that step."""
    num = 10_000
    rng = np.random.default_rng(0)
    mj_model = compiled(hinge)
    sim = simulation(mj_model, friction_effects(), {}, num_sims=num, control_period=0.001)
    sim.set_parameters(
        {
            "backward_efficiency": torch.from_numpy(rng.uniform(0.6, 1.0, num)),
            "coulomb_friction": torch.from_numpy(rng.uniform(0.01, 0.25, num)),
            "static_friction_excess": torch.from_numpy(rng.uniform(0.0, 0.25, num)),
            "viscous_friction": torch.from_numpy(rng.uniform(0.0025, 0.15, num)),
        }
    )
    friction = sim.batch.bind("qfrc_constraint")
    qpos = rng.uniform(-np.pi, np.pi, (num, 1))
    target = torch.from_numpy(qpos + rng.uniform(-1, 1, (num, 1)))
    sim.reset(qpos, {"position_target": target, "p_gain": 6.0}, rng.normal(0, 3, (num, 1)))
    for _ in range(3):
        before = sim.signals.velocity.clone()[:, 0].numpy()
        sim.advance()
        after = sim.signals.velocity[:, 0].numpy()
        power = friction[:, 0] * before
        kept_direction = np.sign(before) == np.sign(after)
        assert (power[kept_direction] <= 1e-9).all()
        assert kept_direction.mean() > 0.5


def test_a_joint_at_93_percent_of_its_bound_does_not_creep(hinge):
    """Held just inside its friction bound, a joint moves at most 5 mrad in 5 s; outside it, it slips."""
    torque = 0.3 * 9.81 * 0.1 * np.sin(1.0)
    sim = simulation(compiled(hinge), [CurrentPD(), Motor(), Coulomb()], IDEAL, num_sims=2)
    sim.set_parameters({"coulomb_friction": torch.tensor([torque / 0.93, torque / 1.07])})
    sim.reset([1.0], {"p_gain": 0.0, "d_gain": 0.0})
    for _ in range(625):
        sim.advance()
    moved = (sim.signals.position[:, 0] - 1.0).abs()
    assert moved[0] < 0.005
    assert moved[1] > 0.05


def test_a_diverging_simulation_is_reported_and_alone(hinge):
    """A non-finite command or an absurd gain fails its own simulation and no other."""
    sim = simulation(compiled(hinge), friction_effects(), {}, num_sims=3)
    sim.reset([0.3], {"p_gain": 3.0})
    sim.command(position_target=torch.tensor([[0.1], [float("nan")], [0.2]], dtype=torch.float64))
    for _ in range(20):
        sim.advance()
    assert sim.failed.tolist() == [False, True, False]
    assert torch.isfinite(sim.signals.position[[0, 2]]).all()
    alone = simulation(compiled(hinge), friction_effects(), {}, num_sims=1)
    alone.reset([0.3], {"p_gain": 3.0})
    alone.command(position_target=0.1)
    for _ in range(20):
        alone.advance()
    assert torch.equal(alone.signals.position[0], sim.signals.position[0])


def test_bad_arguments_are_named(hinge):
    """Unknown parameters, unknown commands and odd periods are refused with what would be right."""
    mj_model = compiled(hinge)
    sim = simulation(mj_model, friction_effects(), {})
    with pytest.raises(ValueError, match="coulomb_friction"):
        sim.set_parameters({"coulomb": 1.0})
    with pytest.raises(ValueError, match="position_target"):
        sim.command(target=0.0)
    with pytest.raises(ValueError, match="multiple"):
        simulation(mj_model, friction_effects(), {}, control_period=0.0015)
    with pytest.raises(ValueError, match="no joint 'knee'"):
        BatchSimulation(mj_model, ["knee"], RobotModel((Motor(),)), 1)


@pytest.mark.parametrize(
    ("default", "message"),
    [
        ('<joint axis="0 0 1"/>', None),
        ('<joint type="slide"/>', "hinge"),
    ],
)
def test_default_classes_do_not_change_the_servo_silently(default, message):
    """What a default class says of the joint is honoured or refused, never half of it."""
    from dm_control import mjcf

    root = mjcf.from_xml_string(
        f"""<mujoco><default>{default}<motor gear="50" ctrlrange="-1 1" ctrllimited="true"/></default><worldbody>
        <body><inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-4 1e-4 1e-4"/><joint name="hinge"/></body>
        </worldbody></mujoco>"""
    )
    attach_servos([root.find("joint", "hinge")])
    mj_model = mujoco.MjModel.from_xml_string(root.to_xml_string())
    if message:
        with pytest.raises(ValueError, match=message):
            simulation(mj_model, [CurrentPD(), Motor()], IDEAL)
    else:
        assert mj_model.actuator_gear[0, 0] == 1
        assert not mj_model.actuator_ctrllimited[0]
        simulation(mj_model, [CurrentPD(), Motor()], IDEAL)
