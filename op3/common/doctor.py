"""Checks of a machine's requirements for op3, with remedies."""

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

GOOD, POOR, BAD = "ok", "note", "missing"
LATENCY = 1
"""Largest latency timer of a USB adapter [ms]; with more, a tick of 8 ms takes 15 to 20 ms."""

ADAPTERS = Path("/sys/bus/usb-serial/devices")
"""Folder in which the kernel lists serial adapters."""

Line = tuple[str, str, str]
"""State, topic, and result with its remedy."""


def report() -> str:
    """All checks, one line each."""
    lines = [line for check in (python, processors, packages, rendering, disk, adapters) for line in check()]
    return "\n".join(f"{verdict:8s}{topic:12s}{text}" for verdict, topic, text in lines)


def python() -> Iterator[Line]:
    """The Python version, compared with the package's requirement."""
    wanted = importlib.metadata.metadata("op3").get("Requires-Python", "")
    fits = SpecifierSet(wanted).contains(platform.python_version())
    text = f"{platform.python_version()} on {platform.platform()}; op3 requires {wanted or 'any'}"
    yield GOOD if fits else BAD, "Python", text


def processors() -> Iterator[Line]:
    """Cores and memory."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    note = "" if cores >= 2 else ": training cannot collect and learn in parallel; use two cores or more"
    yield GOOD if cores >= 2 else POOR, "cores", f"{cores}, {memory:.0f} GB of memory{note}"


def packages() -> Iterator[Line]:
    """Required packages and extras."""
    extras = ["", *sorted({*(importlib.metadata.metadata("op3").get_all("Provides-Extra") or [])} - {"dev"})]
    there = {canonicalize_name(one.name) for one in importlib.metadata.distributions()}
    for requirement in map(Requirement, importlib.metadata.requires("op3") or []):
        marker = requirement.marker
        extra = next((each for each in extras if marker is None or marker.evaluate({"extra": each})), None)
        if extra is not None and canonicalize_name(requirement.name) not in there:
            how = f"pip install 'op3[{extra}]'" if extra else f"pip install {requirement.name}"
            yield POOR if extra else BAD, "package", f"{requirement.name} is not installed: {how}"


def rendering() -> Iterator[Line]:
    """Whether MuJoCo can render here, tried in a separate process because a wrong driver may end it."""
    code = "import mujoco; m = mujoco.MjModel.from_xml_string('<mujoco/>'); mujoco.Renderer(m, 32, 32)"
    for backend in (os.environ.get("MUJOCO_GL", ""), "egl", "osmesa"):
        environment = {**os.environ, **({"MUJOCO_GL": backend} if backend else {})}
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False)
        if done.returncode == 0:
            note = f"MUJOCO_GL={backend}" if backend else "as it is"
            yield GOOD, "rendering", f"works with {note}"
            return
    yield POOR, "rendering", "no videos: install EGL (Debian: libegl1, libgl1, libgl1-mesa-dri)"


def disk() -> Iterator[Line]:
    """Free disk space for results."""
    free = shutil.disk_usage(Path.cwd()).free / 2**30
    yield (
        GOOD if free > 2 else POOR,
        "disk",
        f"{free:.0f} GB free here; a training takes about 1 GB",
    )


def latency_timer(port: str, adapters: Path = ADAPTERS) -> tuple[Path, int | None]:
    """The file with the latency timer of a port's adapter, and its value [ms]; None where there is no such timer."""
    name = Path(port).resolve().name
    file = adapters / name / "latency_timer"
    return file, int(file.read_text()) if name and file.is_file() else None


def adapters() -> Iterator[Line]:
    """Serial adapters of a robot: permission and latency."""
    ports = sorted(Path("/dev").glob("ttyUSB*")) + sorted(Path("/dev").glob("ttyACM*"))
    if not ports:
        yield POOR, "robot", "no serial port: plug in the robot, or use port=emulated"
    for port in ports:
        if not os.access(port, os.R_OK | os.W_OK):
            yield BAD, "robot", f"{port} cannot be opened: sudo usermod -aG dialout $USER, then log in again"
            continue
        timer, latency = latency_timer(str(port))
        if latency is None or latency <= LATENCY:
            yield GOOD, "robot", f"{port}"
        else:
            yield BAD, "robot", f"{port} has a latency timer of {latency} ms: echo {LATENCY} | sudo tee {timer}"
