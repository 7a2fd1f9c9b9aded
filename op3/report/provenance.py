"""Where a result comes from: code, command, versions and machine."""

import os
import platform
import shlex
import sys
from collections.abc import Sequence
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

from op3.private import CLAIMED, scrub
from op3.rollout.code_version import git_changes, git_hash

PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "dm-control", "hydra-core", "optuna", "numpy", "scipy")
"""Packages whose versions can change a result."""


def run_provenance(
    *, seed: int | None = None, data: str | Sequence[str] | None = None, command: str | None = None
) -> dict[str, Any]:
    """Everything about a run that its numbers do not say, as plain data for page and result.

    No path appears but those that the caller or the command line gave.

    Args:
        seed: of the run; left out where None.
        data: names of the logs used, as the user gave them; left out where None.
        command: by default this process's command line.
    """
    facts: dict[str, Any] = {"command": command or command_line(), **git_state()}
    facts["date"] = datetime.now().astimezone().isoformat(timespec="seconds")
    if seed is not None:
        facts["seed"] = seed
    if data is not None:
        facts["data"] = scrub(data if isinstance(data, str) else ", ".join(map(str, data)))
    facts["versions"] = versions()
    facts["machine"] = machine()
    return facts


def machine() -> dict[str, Any]:
    """The computer: operating system, processor and number of cores."""
    model = platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = f"{names[0].partition(':')[2].strip()} ({model})" if names else model
    return {"platform": platform.platform(terse=True), "processor": model, "cpu_count": os.cpu_count()}


def command_line() -> str:
    """The command as one could type it again, the script relative to where one stands."""
    script = Path(sys.argv[0] or "-")
    if script.is_absolute():
        here = Path.cwd()
        script = script.relative_to(here) if script.is_relative_to(here) else Path(script.name)
    given = [argument for argument in sys.argv[1:] if argument != os.environ.get(CLAIMED)]
    return scrub(shlex.join(["python", str(script), *given]))


def git_state() -> dict[str, Any]:
    """Commit of the code, and whether files differ from it; ``unknown`` where it is not in its own repository."""
    commit, changed = git_hash(), git_changes()
    if commit is None:
        return {"git_hash": "unknown"}
    return {"git_hash": commit} if changed is None else {"git_hash": commit, "git_changes": changed}


def versions() -> dict[str, str]:
    """Versions of Python, this package and `PACKAGES`, where installed."""
    found = {"python": platform.python_version()}
    for package in ("op3", *PACKAGES):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
