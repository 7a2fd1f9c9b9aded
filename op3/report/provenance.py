"""Provenance of a result: code, command, versions and machine."""

import os
import platform
import shlex
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from op3.common.private import CLAIMED, scrub
from op3.rollout.code_version import git_changes, git_hash

PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "dm-control", "hydra-core", "optuna", "numpy", "scipy")
"""Packages whose versions can change a result."""


def run_provenance(*, seed: int | None = None, data: str | Sequence[str] | None = None) -> dict[str, Any]:
    """Provenance of a run as plain data for the page and the result.

    Only paths from the caller or the command line appear; seed and log names are omitted if None.
    """
    commit, changed = git_hash(), git_changes()
    facts: dict[str, Any] = {"command": command_line(), "git_hash": commit or "unknown"}
    facts |= {} if commit is None or changed is None else {"git_changes": changed}
    facts["date"] = datetime.now().astimezone().isoformat(timespec="seconds")
    facts |= {} if seed is None else {"seed": seed}
    facts |= {} if data is None else {"data": scrub(data if isinstance(data, str) else ", ".join(map(str, data)))}
    return {**facts, "versions": versions(), "machine": machine()}


def machine() -> dict[str, Any]:
    """The computer: operating system, processor and number of cores."""
    model = platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = f"{names[0].partition(':')[2].strip()} ({model})" if names else model
    return {"platform": platform.platform(terse=True), "processor": model, "cpu_count": os.cpu_count()}


def command_line() -> str:
    """The command as a user would type it, with the script's path relative to the current folder."""
    script = Path(sys.argv[0] or "-")
    if script.is_absolute():
        here = Path.cwd()
        script = script.relative_to(here) if script.is_relative_to(here) else Path(script.name)
    given = [argument for argument in sys.argv[1:] if argument != os.environ.get(CLAIMED)]
    return scrub(shlex.join(["python", str(script), *given]))


def versions() -> dict[str, str]:
    """Versions of Python, this package and `PACKAGES`, where installed."""
    found = {"python": platform.python_version()}
    for package in ("op3", *PACKAGES):
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found
