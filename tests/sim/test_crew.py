"""Work shared among processes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from op3.sim.crew import Crew


class Worker:
    """Does what the tests ask."""

    def __init__(self, offset: int):
        self.offset = offset

    def add(self, value: int) -> tuple[int, int]:
        return os.getpid(), value + self.offset

    def refuse(self, value: int) -> int:
        if value == 2:
            raise ValueError(f"{value} is refused")
        return value

    def end(self, value: int) -> int:
        if value == 2:
            os._exit(1)
        return value


def test_parts_are_done_elsewhere_in_their_order():
    """The first part is done here, the others in processes that live on."""
    crew = Crew(Worker, {"offset": 10}, 3)
    first, second = (crew.run("add", [{"value": i} for i in range(3)]) for _ in range(2))
    assert [value for _, value in first] == [10, 11, 12]
    assert first[0][0] == second[0][0] == os.getpid()
    others = {process for process, _ in first[1:] + second[1:]}
    assert os.getpid() not in others
    assert len(others) <= 2


def test_an_error_elsewhere_is_raised_here_and_the_crew_works_on():
    """A part that fails in another process fails the call."""
    crew = Crew(Worker, {"offset": 0}, 2)
    with pytest.raises(ValueError, match="2 is refused"):
        crew.run("refuse", [{"value": 1}, {"value": 2}])
    assert crew.run("refuse", [{"value": 3}, {"value": 4}]) == [3, 4]


def test_a_process_that_ends_is_an_error():
    """A killed process ends the call at once instead of leaving it waiting."""
    crew = Crew(Worker, {"offset": 0}, 2)
    with pytest.raises(ChildProcessError, match="has ended"):
        crew.run("end", [{"value": 1}, {"value": 2}])
    assert crew.run("end", [{"value": 3}, {"value": 4}]) == [3, 4]


@pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")
def test_a_killed_process_leaves_no_others_behind(tmp_path):
    """After kill -9 of the process that asks, those that help end by themselves."""
    script = tmp_path / "asks.py"
    script.write_text(
        "import sys, time\n"
        "from op3.sim.crew import Crew\n"
        "from tests.sim.test_crew import Worker\n"
        "if __name__ == '__main__':\n"
        "    crew = Crew(Worker, {'offset': 0}, 2)\n"
        "    print(crew.run('add', [{'value': 1}] * 2)[1][0], flush=True)\n"
        "    time.sleep(100)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    asking = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=environment)
    assert asking.stdout is not None
    helping = int(asking.stdout.readline())
    assert _runs(helping)
    asking.send_signal(signal.SIGKILL)
    asking.wait()
    asking.stdout.close()
    deadline = time.monotonic() + 30
    while _runs(helping) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not _runs(helping)


def _runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
