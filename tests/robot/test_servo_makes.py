"""Servos as data."""

from math import pi

import pytest

from op3.robot import load_servo
from op3.robot.servo_make import servo_files

MINIMAL = """\
format: op3-servo/1
name: {name}
maker: us
sources: {{sheet: our data sheet}}
loop: current
supply: {{value: 12, unit: V, source: sheet}}
motor:
  gear_ratio: {{value: 100, source: sheet}}
  torque_constant: {{value: 0.01, unit: N m/A, source: sheet}}
  terminal_resistance: {{value: 4, unit: ohm, source: sheet}}
  armature: {{value: 0.01, unit: kg m^2, source: {source}}}
counts:
  position: {{value: 4096, unit: counts/turn, source: sheet}}
  zero: {{value: 2048, unit: counts, source: sheet}}
  velocity: {{value: 0.229, unit: {unit}, source: sheet}}
  voltage: {{value: 0.1, unit: V, source: sheet}}
limits:
  stall_torque: {{value: 4, unit: N m, at: 12, source: sheet}}
  no_load_speed: {{value: 60, unit: rpm, at: 12, source: sheet}}
  low_voltage: {{value: 10, unit: V, source: sheet}}
  high_voltage: {{value: 14, unit: V, source: sheet}}
  temperature: {{value: 80, unit: C, source: sheet}}
"""


def written(tmp_path, name="ours", source="sheet", unit="rpm", **changes):
    text = MINIMAL.format(name=name, source=source, unit=unit)
    for old, new in changes.items():
        text = text.replace(old, new)
    path = tmp_path / "ours.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", servo_files())
def test_every_make_is_plausible(name):
    """Its stall torque is what its motor's constants give, within what gears lose and data sheets round."""
    make = load_servo(name)
    assert make.name == name
    assert 0.4 < make.limits.stall_torque.si / make.ideal_stall_torque(make.limits.stall_torque.at) < 1.35
    assert 1e-5 < make.motor.armature.si < 0.1


def test_a_new_make_is_one_file(tmp_path):
    """Its vendor's units become SI: 60 rpm are 2 pi rad/s."""
    make = load_servo(written(tmp_path))
    assert make.limits.no_load_speed.si == pytest.approx(2 * pi)
    assert make.output_constant == pytest.approx(1.0)


def test_a_servo_that_closes_its_loop_is_stiffer_at_a_higher_voltage(tmp_path):
    """1 N m/A times 12 V over 4 ohm are 3 N m; 0.5 per rad of it are 1.5 N m/rad, and 1 N m/rad at 8 V."""
    current = load_servo(written(tmp_path))
    assert current.ideal_stall_torque() == pytest.approx(3.0)
    assert current.stiffness(8.0) == current.stiffness() == pytest.approx(1.0)
    figures = {"error_gain": "0.5, unit: 1/rad", "max_duty": "1", "goal_speed": "30, unit: rad/s", "gain": "1"}
    law = "".join(f"  {name}: {{value: {figure}, source: sheet}}\n" for name, figure in figures.items())
    (other := tmp_path / "firmware").mkdir()
    firmware = load_servo(written(other, **{"loop: current": f"loop: firmware\nposition_law:\n{law.rstrip()}"}))
    assert firmware.stiffness() == pytest.approx(1.5)
    assert firmware.stiffness(8.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"unit": "rmp"}, r"line 15: counts.velocity.unit names the unit 'rmp'.* the nearest is 'rpm'"),
        ({"source": "sheeet"}, r"line 11: motor.armature.source names the source 'sheeet'.* the nearest is 'sheet'"),
        (
            {"loop: current": "loop: curent"},
            r"line 5: loop must be one of 'current' or 'firmware', got 'curent'",
        ),
        ({"loop: current": "loop: firmware"}, r"line 5: loop is 'firmware', so the file needs a position_law"),
        ({"gear_ratio": "gear_ration"}, r"line 8: motor.gear_ration is not a field; the nearest is 'gear_ratio'"),
        ({"value: 4, unit: ohm": "unit: ohm"}, r"line 10: motor.terminal_resistance.value is missing"),
        ({"value: 4, unit: ohm": "value: -4, unit: ohm"}, r"line 10: motor.terminal_resistance.value must be above 0"),
        (
            {"value: 4, unit: ohm": "value: '4', unit: ohm"},
            r"line 10: motor.terminal_resistance.value must be a number",
        ),
        ({"value: 4, unit: ohm": "value: 4, unit: V"}, r"line 10: motor.terminal_resistance is in V, not in ohm"),
        ({"unit": "V"}, r"line 15: counts.velocity is in V, not in rpm or s/60deg or rad/s"),
        ({"value: 12, unit: V": "value: 50, unit: V"}, r"line 6: supply is 50 V, outside its limits 10 to 14 V"),
        (
            {"maker: us": "maker: us\nmodle_number: 3"},
            r"line 4: modle_number is not a field; the nearest is 'model_number'",
        ),
        ({"name": "theirs"}, r"line 2: name is 'theirs', but the file is called 'ours.yaml'"),
    ],
)
def test_a_wrong_file_is_refused_in_one_sentence(tmp_path, change, sentence):
    """With its line and the nearest valid name."""
    with pytest.raises(ValueError, match=sentence):
        load_servo(written(tmp_path, **change))


def test_an_unknown_make_is_answered_with_the_nearest():
    """A slip of the pen."""
    with pytest.raises(ValueError, match="there is no servo 'xm430-w35'; the nearest is 'xm430-w350'"):
        load_servo("xm430-w35")
