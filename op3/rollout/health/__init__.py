"""Checks of a log for impossible and suspicious values, with remedies."""

from __future__ import annotations

from importlib import import_module

from op3.rollout.finding import ERROR, WARNING, LogFinding, merge_findings
from op3.rollout.health.log_view import CHECKS, examine

# each module registers its checks; the first error is raised, so causes come before their consequences
_ORDER = "clock sidecar numbers tracking_faults velocity stops drives inertial_sensor ranges"
for _name in _ORDER.split():
    import_module(f"{__name__}.{_name}")

__all__ = ["CHECKS", "ERROR", "WARNING", "LogFinding", "checks_table", "examine", "merge_findings"]


def checks_table() -> str:
    """The checks as Markdown, for documentation."""
    lines = ["| check | finds |", "|---|---|"]
    lines += [f"| {name} | {' '.join(str(one.find.__doc__).split())} |" for name, one in CHECKS.items()]
    return "\n".join(lines) + "\n"
