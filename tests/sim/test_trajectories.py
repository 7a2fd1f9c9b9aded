"""Dynamics along a measured motion: what a base that turns asks of the joints that it carries."""

import mujoco
import numpy as np

from op3.robot import load_robot
from op3.sim.held_base import fixed_base


def test_a_turning_base_asks_for_what_accelerates_every_body():
    """The torques are those of all bodies one by one: their masses pulled along, their inertias turned."""
    held = fixed_base(tuple(load_robot("op3").joints), "op3", (0.1, -0.2))
    position = np.random.default_rng(0).normal(0.0, 0.4, (2, len(held.joints)))
    found = held.along(held.mj_model, position, np.zeros_like(position)).carried
    model, data = held.mj_model, mujoco.MjData(held.mj_model)
    data.qpos[:] = held.qpos
    for angles, carried in zip(position, found, strict=True):
        data.qpos[held.ports.qpos] = angles
        mujoco.mj_forward(model, data)
        axes = data.xmat[held.base].reshape(3, 3).T
        expected = np.zeros((model.nv, 3))
        for body in range(1, model.nbody):
            pulled, turned = np.zeros((2, 3, model.nv))
            mujoco.mj_jacBodyCom(model, data, pulled, turned, body)
            frame = data.ximat[body].reshape(3, 3)
            inertia = frame @ np.diag(model.body_inertia[body]) @ frame.T
            force = model.body_mass[body] * np.cross(axes, data.xipos[body] - data.xpos[held.base])
            expected += pulled.T @ force.T + turned.T @ inertia @ axes.T
        np.testing.assert_allclose(carried, expected[held.ports.dof], atol=1e-12)
        assert np.abs(carried).max() > 0.01
