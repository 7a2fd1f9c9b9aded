"""Packets: the manual's examples, stuffing, and a parser that garbage does not fool."""

import pytest
from dynamixel_sdk import PacketHandler
from hypothesis import example, given
from hypothesis import strategies as st

from op3.deploy.protocol import (
    BROADCAST_ID,
    MAX_LENGTH,
    Instruction,
    Packet,
    Parser,
    crc16,
    encode,
    encode_fast_status,
    encode_status,
)

# ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0", section by section
MANUAL = {
    "ping": (encode(1, Instruction.PING), "FF FF FD 00 01 03 00 01 19 4E"),
    "ping all": (encode(BROADCAST_ID, Instruction.PING), "FF FF FD 00 FE 03 00 01 31 42"),
    "ping status": (encode_status(1, 0, b"\x06\x04\x26"), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    "read": (encode(1, Instruction.READ, b"\x84\x00\x04\x00"), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    "read status": (encode_status(1, 0, b"\xa6\x00\x00\x00"), "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
    "write": (
        encode(1, Instruction.WRITE, b"\x74\x00\x00\x02\x00\x00"),
        "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89",
    ),
    "write status": (encode_status(1, 0), "FF FF FD 00 01 04 00 55 00 A1 0C"),
    "reboot": (encode(1, Instruction.REBOOT), "FF FF FD 00 01 03 00 08 2F 4E"),
    "sync read": (
        encode(BROADCAST_ID, Instruction.SYNC_READ, b"\x84\x00\x04\x00\x01\x02"),
        "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA",
    ),
    "bulk read": (
        encode(BROADCAST_ID, Instruction.BULK_READ, bytes.fromhex("01 90 00 02 00 02 92 00 01 00")),
        "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
    ),
    "fast sync read": (
        encode(BROADCAST_ID, Instruction.FAST_SYNC_READ, b"\x84\x00\x04\x00\x03\x07\x04"),
        "FF FF FD 00 FE 0A 00 8A 84 00 04 00 03 07 04 20 F2",
    ),
}


@pytest.mark.parametrize("name", MANUAL)
def test_packets_are_those_of_the_manual(name):
    """Every example packet of the manual comes out byte by byte."""
    packet, expected = MANUAL[name]
    assert packet == bytes.fromhex(expected)


def test_a_fast_answer_is_that_of_the_manual():
    """Three devices build one packet, each with a CRC over everything before it."""
    data = {3: b"\xa6\0\0\0", 7: b"\x1f\x08\0\0", 4: b"\xff\x03\0\0"}
    pieces = encode_fast_status([(0, device, content) for device, content in data.items()])
    assert [piece.hex(" ") for piece in pieces] == [
        "ff ff fd 00 fe 19 00 55 00 03 a6 00 00 00 84 08",
        "00 07 1f 08 00 00 16 ca",
        "00 04 ff 03 00 00 d1 9e",
    ]


@given(st.binary(max_size=64))
def test_the_crc_is_that_of_dynamixel_sdk(data):
    """Two tables of one polynomial."""
    assert crc16(data) == PacketHandler(2.0).updateCRC(0, list(data), len(data))


# bytes that make stuffing likely
tricky = st.lists(st.sampled_from([0xFF, 0xFD, 0x00, 0x55, 0x01]), max_size=40).map(bytes)


@given(st.integers(0, 252), st.integers(1, 0x9A), tricky, tricky, st.integers(1, 7))
def test_what_is_encoded_is_parsed_whatever_stands_before_it(device, instruction, parameters, garbage, chunk):
    """A packet behind any garbage, fed in pieces of any size, is found with its parameters intact."""
    garbage = garbage.replace(b"\xff\xff\xfd\x00", b"")  # a header of its own would swallow what follows it
    stream = garbage + b"\x00" + encode(device, instruction, parameters)
    parser, found = Parser(), []
    for at in range(0, len(stream), chunk):
        found += parser.feed(stream[at : at + chunk])
    assert Packet(device, instruction, parameters) in found


@given(tricky)
@example(b"\xff\xff\xfd\xff\xfd\xfd")
def test_dynamixel_sdk_stuffs_alike(parameters):
    """The SDK puts the same bytes into an instruction."""
    length = len(parameters) + 3
    bare = [0xFF, 0xFF, 0xFD, 0, 1, length & 0xFF, length >> 8, Instruction.WRITE, *parameters, 0, 0]
    assert bytes(PacketHandler(2.0).addStuffing(bare)[:-2]) == encode(1, Instruction.WRITE, parameters)[:-2]


def test_a_packet_behind_a_damaged_one_is_found():
    """A wrong length that points far ahead does not swallow what follows for ever."""
    good = encode(7, Instruction.PING)
    damaged = bytearray(encode(1, Instruction.READ, b"\x84\x00\x04\x00"))
    damaged[5] = 30
    parser = Parser()
    found = parser.feed(bytes(damaged) + good * 4)
    assert found.count(Packet(7, Instruction.PING, b"")) >= 2


def test_a_packet_that_is_too_long_is_refused():
    """What the receiver would not believe is not sent."""
    with pytest.raises(ValueError, match="at most"):
        encode(1, Instruction.WRITE, bytes(MAX_LENGTH))
