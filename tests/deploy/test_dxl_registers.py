"""Register tables: addresses and sizes of the manual, and conversion of units."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from op3.deploy.registers import DYNAMIXEL_X, OPEN_CR, OPEN_CR_MODEL

# ROBOTIS e-Manual, XM430-W350: name, address, size, initial value
MANUAL = [
    ("model_number", 0, 2, 1020),
    ("id", 7, 1, 1),
    ("return_delay_time", 9, 1, 250),
    ("operating_mode", 11, 1, 3),
    ("temperature_limit", 31, 1, 80),
    ("current_limit", 38, 2, 1193),
    ("shutdown", 63, 1, 52),
    ("torque_enable", 64, 1, 0),
    ("hardware_error_status", 70, 1, 0),
    ("position_p_gain", 84, 2, 800),
    ("bus_watchdog", 98, 1, 0),
    ("goal_position", 116, 4, None),
    ("present_current", 126, 2, None),
    ("present_velocity", 128, 4, None),
    ("present_position", 132, 4, None),
    ("present_input_voltage", 144, 2, None),
    ("present_temperature", 146, 1, None),
    ("indirect_address_1", 168, 2, 224),
    ("indirect_address_28", 222, 2, 251),
    ("indirect_data_1", 224, 1, 0),
    ("indirect_address_29", 578, 2, 634),
    ("indirect_data_56", 661, 1, 0),
]


@pytest.mark.parametrize(("name", "address", "size", "initial"), MANUAL)
def test_the_servo_has_the_registers_of_the_manual(name, address, size, initial):
    """Address, size and factory value are those of the manual."""
    register = DYNAMIXEL_X[name]
    assert (register.address, register.size) == (address, size)
    assert initial is None or register.initial == initial
    assert register.eeprom == (address < 64 and name != "model_number")


def test_the_open_cr_has_the_registers_of_its_firmware():
    """IMU, power and voltage stand where the OP3's firmware has them."""
    places = {"dynamixel_power": 24, "button": 30, "present_voltage": 31, "gyro_x": 32, "acceleration_x": 38, "yaw": 48}
    assert {name: OPEN_CR[name].address for name in places} == places
    assert OPEN_CR_MODEL == 29696


@given(st.sampled_from([r for r in DYNAMIXEL_X if r.signed]), st.integers(-(2**15), 2**15 - 1))
def test_values_survive_the_wire(register, value):
    """What is encoded is decoded, sign and all."""
    if register.size == 1:
        value //= 256
    assert register.decode(register.encode(value)) == value


def test_a_value_that_does_not_fit_is_refused():
    """Nothing is cut off silently."""
    with pytest.raises(ValueError, match="goal_current"):
        DYNAMIXEL_X["goal_current"].encode(40_000)
