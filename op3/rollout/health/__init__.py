"""Checks of a log: what cannot be right, what is suspicious, and how to correct it."""

from __future__ import annotations

from importlib import import_module

from op3.rollout.health.finding import CHECKS, ERROR, WARNING, LogFinding, examine, told_together

# each enters its checks into the registry; of several errors the first is told, so causes come before what they bring
_ORDER = "clock sidecar numbers angles velocity still follows drive_signals inertial_sensor ranges"
for _name in _ORDER.split():
    import_module(f"{__name__}.{_name}")

__all__ = ["CHECKS", "ERROR", "WARNING", "LogFinding", "checks_table", "examine", "told_together"]


def checks_table() -> str:
    """The checks as Markdown, for documentation."""
    lines = ["| check | finds |", "|---|---|"]
    lines += [f"| {name} | {' '.join(str(function.__doc__).split())} |" for name, function in CHECKS.items()]
    return "\n".join(lines) + "\n"
