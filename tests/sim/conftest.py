"""Small scenes that the simulation tests share."""

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
