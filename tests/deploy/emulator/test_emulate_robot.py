"""The script that serves an emulated robot: however it is told to end, it ends whole."""

import contextlib
import os
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

from dynamixel_sdk import PacketHandler, PortHandler
from serial import SerialException

from op3.deploy.registers import OPEN_CR_ID

ROOT = Path(__file__).resolve().parents[3]


def serve(folder, record):
    """The script, started, and the port that it printed."""
    command = [sys.executable, "-W", "ignore", str(ROOT / "experiments" / "emulate_robot.py"), "model=paper"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [*command, f"record={record}", f"hydra.run.dir={folder}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        # Under `nohup` a hangup arrives ignored, and the script rightly leaves it so.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )
    assert process.stdout is not None
    return process, process.stdout.readline().removeprefix("port:").strip()


def assert_ended(process):
    """It said how long it served, and nothing went wrong."""
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert output.splitlines()[-1].startswith("emulated ")
    assert "Traceback" not in errors


def test_signals_right_behind_the_port_and_again(tmp_path):
    """A signal may come while the first lines are printed, and others while it ends."""
    process, _ = serve(tmp_path, tmp_path / "frames.txt")
    for _ in range(20):
        process.send_signal(signal.SIGHUP)
        time.sleep(0.002)
    assert_ended(process)


def test_a_failure_is_told(tmp_path):
    """What ends the serving is one sentence behind the closing line, with exit code 1: here the disk is full."""
    process, path = serve(tmp_path, "/dev/full")
    port, packets = PortHandler(path), PacketHandler(2.0)
    assert port.setBaudRate(2_000_000)
    end = time.monotonic() + 60
    with contextlib.suppress(SerialException, OSError, termios.error):
        while time.monotonic() < end:
            packets.ping(port, OPEN_CR_ID)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "emulated " in output
    assert "No space left" in errors
    assert "Traceback" not in errors
