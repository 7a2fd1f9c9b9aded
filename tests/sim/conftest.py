"""Small scenes that the simulation tests share."""

import mujoco
import numpy as np
import pytest
from dm_control import mjcf

HINGE = """
<mujoco>
  <option timestep="{timestep}" integrator="implicitfast"><flag gravity="{gravity}"/></option>
  <worldbody>
    <body name="link">
      <inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-4 1e-4 1e-4"/>
      <joint name="hinge" type="hinge" axis="0 1 0" armature="0.005"/>
    </body>
  </worldbody>
</mujoco>"""


@pytest.fixture
def hinge():
    """Factory of a pendulum's MJCF and its joint element."""

    def make(timestep: float = 0.001, gravity: bool = True):
        root = mjcf.from_xml_string(HINGE.format(timestep=timestep, gravity="enable" if gravity else "disable"))
        return root, root.find("joint", "hinge")

    return make


@pytest.fixture(scope="session")
def dc_motor():
    """Positions of that pendulum driven by MuJoCo's own DC motor, of 5 ohm and 2.1 N m/A at the joint."""

    def positions(voltages, substeps: int, timestep: float = 0.001, gravity: bool = True, **options) -> np.ndarray:
        xml = HINGE.format(timestep=timestep, gravity="enable" if gravity else "disable")
        spec = mujoco.MjSpec.from_string(
            xml.replace("</mujoco>", '<actuator><motor joint="hinge"/></actuator></mujoco>')
        )
        constant, voltage = 0.006 * 353.5, int(mujoco.mjtCtrlInput.mjINPUT_VOLTAGE)
        spec.actuators[0].set_to_dcmotor(motorconst=[constant] * 2, resistance=5.0, ctrlspec=voltage, **options)
        model = spec.compile()
        data, places = mujoco.MjData(model), []
        for voltage in voltages:
            data.ctrl[0] = voltage
            mujoco.mj_step(model, data, substeps)
            places.append(data.qpos[0])
        return np.array(places)

    return positions
