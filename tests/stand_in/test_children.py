"""Processes of a bench: forked scripts are like started ones, and nothing is left of what was stopped."""

import os
import sys
import time
from pathlib import Path

import pytest

from op3.stand_in.children import run_command


@pytest.fixture(params=["forked", "started"])
def python(request):
    """This interpreter as it is forked, and started by another program."""
    return [sys.executable] if request.param == "forked" else ["env", sys.executable]


def test_a_script_is_run_as_from_a_shell(tmp_path, python):
    """It has its arguments, its own folder on the path, and a session of its own; all it prints is in the log."""
    (tmp_path / "beside.py").write_text("here = 7\n")
    script = tmp_path / "script.py"
    script.write_text(
        "import os, sys, subprocess, beside\n"
        "assert __name__ == '__main__' and os.getsid(0) == os.getpid()\n"
        "print(sys.argv[1:], beside.here, flush=True)\n"
        "subprocess.run(['echo', 'from a child'], check=True)\n"
        "sys.exit('not well')\n"
    )
    run_command([*python, str(script), "a", "b c"], tmp_path / "log", 60.0)
    assert (tmp_path / "log").read_text().splitlines() == ["['a', 'b c'] 7", "from a child", "not well"]


def test_scripts_do_not_see_each_other(tmp_path, python):
    """What one script changes in a module is not changed for the next."""
    script = tmp_path / "script.py"
    script.write_text("import op3.robot as m; print(getattr(m, 'left', None)); m.left = 1\n")
    for log in ("one", "two"):
        run_command([*python, str(script)], tmp_path / log, 60.0)
        assert (tmp_path / log).read_text() == "None\n"


def test_a_traceback_is_in_the_log(tmp_path, python):
    """An error shows as on a terminal."""
    script = tmp_path / "script.py"
    script.write_text("raise RuntimeError('the reason')\n")
    run_command([*python, str(script)], tmp_path / "log", 60.0)
    assert "RuntimeError: the reason" in (tmp_path / "log").read_text()


def test_what_takes_too_long_is_stopped_with_its_children(tmp_path, python):
    """After the time is over, no process of the group is left, and the log says so."""
    script = tmp_path / "script.py"
    script.write_text(
        "import subprocess, time\nprint(subprocess.Popen(['sleep', '300']).pid, flush=True)\ntime.sleep(300)\n"
    )
    begin = time.monotonic()
    run_command([*python, str(script)], tmp_path / "log", 8.0)
    assert time.monotonic() - begin < 60
    child, *rest = (tmp_path / "log").read_text().split("\n", 1)
    assert "stopped after 8 s" in rest[0]
    for _ in range(50):
        try:
            os.kill(int(child), 0)
        except ProcessLookupError:
            return
        if "Z" in Path(f"/proc/{child}/stat").read_text().split(")")[1][:3]:
            return  # dead, and waited for by nobody
        time.sleep(0.1)
    pytest.fail("the child of the stopped script is alive")
