"""Robots that are not in the repository, written by tests."""

from pathlib import Path

LINK = '<geom type="capsule" fromto="0 0 0 {to}" size="0.01" mass="{mass}" contype="0" conaffinity="0"/>'


def _arm() -> tuple[str, str]:
    """Four hinges in a row on a table, with motors and friction of its own that a servo model replaces."""
    body = ""
    places = {"0 0 1": 0.0, "0 1 0": 0.05, "0 1 0.0": 0.12, "1 0 0": 0.12}
    for number, (axis, place) in enumerate(places.items()):
        body += f'<body name="link{number}" pos="0 0 {place}"><joint name="j{number}" axis="{axis}"'
        body += f' range="-1.5 1.5" damping="3" armature="0.1"/>{LINK.format(to="0 0 0.1", mass=0.1)}'
    model = f"""<mujoco model="four"><compiler angle="radian" autolimits="true"/><worldbody><body name="base">
    <geom size="0.04" mass="1" contype="0" conaffinity="0"/>{body}{"</body>" * 4}</body></worldbody>
    <actuator><position joint="j0" kp="50"/></actuator></mujoco>"""
    file = """\
format: op3-robot/1
name: four
model: four.xml
base: base
fixed: true
servo: sts3215
joints:
  j0: {bus_id: 1}
  j1: {bus_id: 2, home: 0.4}
  j2: {bus_id: 3, home: 0.5, log: {sign: -1, zero: 2048, unit: count}}
  j3:
"""
    return model, file.replace("  j3:", "  j3: {bus_id: 4}")


def _base() -> tuple[str, str]:
    """A free trunk with an IMU on two wheels without limits."""
    wheel = """<body name="{side}_wheel" pos="0 {y} 0"><joint name="{side}" axis="0 1 0"/>
    <geom type="cylinder" size="0.05 0.01" zaxis="0 1 0" mass="0.2"/>
    <geom size="0.01" pos="0.03 0 0" mass="0.1"/></body>"""
    model = f"""<mujoco model="base"><worldbody><body name="chassis" pos="0 0 0.05"><freejoint/>
    <geom type="box" size="0.1 0.08 0.03" mass="2" pos="0 0 0.05"/><site name="imu"/>
    {wheel.format(side="left", y=0.1)}{wheel.format(side="right", y=-0.1)}</body></worldbody></mujoco>"""
    file = """\
format: op3-robot/1
name: base
model: base.xml
base: chassis
imu: imu
servo: xm430-w210
joints:
  left: {mirror: right}
  right:
"""
    return model, file


def _quadruped() -> tuple[str, str]:
    """Four legs of two joints on a trunk, mirrored left and right."""
    leg = """<body name="{name}_thigh" pos="{x} {y} 0"><joint name="{name}_hip" axis="0 1 0" range="-1 1"/>{link}
    <body name="{name}_shin" pos="0 0 -0.1"><joint name="{name}_knee" axis="0 1 0" range="-2 0.2"/>{link}</body>
    </body>"""
    link = LINK.format(to="0 0 -0.1", mass=0.08)
    places = {"lf": (0.1, 0.06), "rf": (0.1, -0.06), "lh": (-0.1, 0.06), "rh": (-0.1, -0.06)}
    legs = "".join(leg.format(name=name, x=x, y=y, link=link) for name, (x, y) in places.items())
    model = f"""<mujoco model="dog"><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 0.2"><freejoint/>
    <geom type="box" size="0.12 0.05 0.03" mass="1"/><site name="imu"/>{legs}</body></worldbody></mujoco>"""
    joints = ""
    for name in places:
        pair = f", mirror: r{name[1:]}" if name.startswith("l") else ""
        joints += f"  {name}_hip: {{home: 0.5{pair + '_hip' if pair else ''}}}\n"
        joints += f"  {name}_knee: {{home: -1.0{pair + '_knee' if pair else ''}}}\n"
    head = "format: op3-robot/1\nname: dog\nmodel: dog.xml\nbase: trunk\nimu: imu\n"
    return model, f"{head}feet: [lf_shin, rf_shin, lh_shin, rh_shin]\nservo: xm430-w350\njoints:\n{joints}"


ROBOTS = {"four": _arm, "base": _base, "dog": _quadruped}


def write_robot(folder: Path, name: str, changes: dict[str, str] | None = None) -> Path:
    """Write model and robot file of one of `ROBOTS`, with texts of the file replaced; its path."""
    model, file = ROBOTS[name]()
    for old, new in (changes or {}).items():
        assert old in file
        file = file.replace(old, new)
    (folder / f"{name}.xml").write_text(model)
    path = folder / f"{name}.yaml"
    path.write_text(file)
    return path
