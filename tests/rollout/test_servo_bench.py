"""The servo-bench importer, on real recordings and on damaged ones."""

from __future__ import annotations

import json
import lzma
from typing import Any

import numpy as np
import pytest
from rollout_logs import SERVO_BENCH

from op3.rollout import LogError, read_log, read_logs

needs_recordings = pytest.mark.skipif(not SERVO_BENCH.is_dir(), reason=f"no servo recordings in {SERVO_BENCH}")


def recording(motor: str = "xl330", **changes: Any) -> dict[str, Any]:
    """Three samples of a pendulum, as the recorders write them."""
    volts, temp = (60.0, 0) if motor == "sts3032" else (7.3, 39)
    entry = dict(position=0.1, speed=0.0, load=0, input_volts=volts, temp=temp, goal_position=0.2, torque_enable=True)
    entries = [dict(entry, timestamp=t) for t in (0.004, 0.0095, 0.0146)]
    header = dict(mass=0.49, length=0.1, kp=200, vin=7.4, motor=motor, trajectory="sin_sin", entries=entries)
    return {**header, **changes}


def read(folder, content: dict[str, Any]):
    """Write the recording and import it."""
    path = folder / "2026-01-15_10h28m10.json"
    path.write_text(json.dumps(content))
    return read_log(path)


def test_every_quantity_finds_its_channel(tmp_path):
    """A recording of the XL330 becomes SI channels and metadata, time stamps untouched."""
    content = recording()
    content["entries"][0]["load"] = 65536 - 885
    content["entries"][1]["load"] = 177
    content["entries"][2]["torque_enable"] = False
    log = read(tmp_path, content)
    expected = {
        "time": [0.004, 0.0095, 0.0146],
        "servo.target": [0.2] * 3,
        "servo.torque_enable": [1, 1, 0],
        "servo.firmware_gain": [200] * 3,
        "servo.duty": [-1.0, 0.2, 0.0],  # 177 / 885 = 0.2
        "servo.voltage": [7.3] * 3,
        "servo.temperature": [39] * 3,
    }
    assert {name: log.column(name).tolist() for name in expected} == expected
    about = log.metadata
    assert (about.robot, about.mount, about.mass, about.length) == ("rig", "pendulum", 0.49, 0.1)
    assert (about.servo, about.firmware_gain, about.battery, about.motion) == ("xl330", 200, 7.4, "sin_sin")
    assert (about.date, about.rate) == ("2026-01-15T10:28:10", pytest.approx(2 / 0.0106))


def test_tenths_of_a_volt_become_volts(tmp_path):
    """The STS3032 reports 0.1 V; its unread load and temperature are absent."""
    log = read(tmp_path, recording("sts3032", vin=6.0))
    assert log.column("servo.voltage").tolist() == [6.0] * 3
    assert ("joint", "duty") not in log
    assert ("joint", "temperature") not in log


def entry(row: int, **changes: Any):
    """A change of one sample; None removes the key."""

    def change(content: dict[str, Any]) -> None:
        sample = content["entries"][row - 1]
        sample.update(changes)
        for name in [name for name, value in sample.items() if value is None]:
            del sample[name]

    return change


BENCH_OFFENCES = {
    "no mass": (lambda c: c.pop("mass"), "field mass: the key is missing"),
    "no entries": (lambda c: c.update(entries=[]), "field entries"),
    "null gain": (lambda c: c.update(kp=None), "field kp"),
    "missing value": (entry(2, speed=None), "row 2, column speed: the value is missing"),
    "text": (entry(2, position="left"), "row 2, column position: 'left' is not a finite number"),
    "huge": (entry(3, speed=10**400), "row 3, column speed"),
    "millivolts": (lambda c: [e.update(input_volts=7300) for e in c["entries"]], "column input_volts"),
    "load": (entry(1, load=70000), "row 1, column load: 70000 is not a 16-bit register value"),
    "degrees": (entry(1, position=57.0), "row 1, column servo.position: 57 is beyond 7 rad and looks like degrees"),
    "a sample that is not a mapping": (
        lambda c: c["entries"].append(3),
        "row 4, column timestamp: the value is missing",
    ),
}


@pytest.mark.parametrize("offence", BENCH_OFFENCES)
def test_a_bad_recording_gets_one_sentence(tmp_path, offence):
    """The sentence names file, key and sample, and says what to do."""
    change, expected = BENCH_OFFENCES[offence]
    change(content := recording())
    with pytest.raises(LogError, match=rf"2026-01-15_10h28m10\.json.*{expected}.*; "):
        read(tmp_path, content)


def test_a_key_that_stands_twice_is_refused(tmp_path):
    """Else the last one would win without a word."""
    path = tmp_path / "run.json"
    path.write_text(json.dumps(recording()).replace('"mass"', '"kp": 16, "mass"', 1))
    with pytest.raises(LogError, match=r"run\.json, field kp: the key appears twice; keep the correct one"):
        read_log(path)


def test_broken_files_are_refused(tmp_path):
    """Cut-off xz data, cut-off JSON and JSON of something else are told apart."""
    whole = json.dumps(recording()).encode()
    for name, content, expected in [
        ("a.json.xz", lzma.compress(whole)[:-20], "compressed data are damaged"),
        ("b.json.xz", b"not xz", "compressed data are damaged"),
        ("c.json", whole[:200], "JSON is damaged or truncated at line 1"),
        ("d.json", b"[1, 2]", "not a mapping"),
        ("e.json", b"\xff\xff\xff\xff", "not JSON"),
    ]:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(LogError, match=expected) as caught:
            read_log(tmp_path / name)
        assert name in str(caught.value)


@needs_recordings
@pytest.mark.parametrize(("folder", "runs", "rate"), [("sts3032", 96, (130, 195)), ("xl330", 12, (180, 255))])
def test_all_recordings_import(folder, runs, rate):
    """Every real recording imports, with its rate, its length of 6 s and a supply near nominal."""
    logs = read_logs(SERVO_BENCH / folder)
    assert len(logs) == runs
    for log in logs:
        assert log.metadata.servo == folder
        assert rate[0] < log.metadata.rate < rate[1]
        assert 5.9 < log.duration < 6.1
        assert np.median(log.column("servo.voltage")) == pytest.approx(log.metadata.battery, rel=0.1)
    motions = [log.metadata.motion for log in logs]
    assert {motions.count(name) for name in set(motions)} == {runs // 4}


@needs_recordings
def test_measured_duty_follows_the_servos_own_law():
    """On the XL330, duty = kp (4096 / 2 pi) / (256 * 885) * (target - position), up to one sample late.

    Duty in register counts is kp / 256 times the position error in register counts; agreement fixes sign,
    scale and two's complement of the imported duty.
    """
    for log in read_logs(SERVO_BENCH / "xl330"):
        gain = log.metadata.firmware_gain * (4096 / (2 * np.pi)) / (256 * 885)
        expected = np.clip(gain * (log.column("servo.target") - log.column("servo.position")), -1, 1)
        driven = log.column("servo.torque_enable") == 1
        duty, expected = log.column("servo.duty")[driven][1:], expected[driven]
        slopes = [duty @ e / (e @ e) for e in (expected[1:], expected[:-1])]
        assert min(abs(slope - 1) for slope in slopes) < 0.05
