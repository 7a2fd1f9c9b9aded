"""Locate where simulation and logs disagree, name the missing effect, add it, show the gap shrink."""

from op3.diagnose.aliasing import aliasing
from op3.diagnose.bench_model import suited
from op3.diagnose.diagnosis import Diagnosis
from op3.diagnose.downstream import downstream
from op3.diagnose.free_run import FreeRunResiduals, engine_for
from op3.diagnose.mounts import diagnosed_mount, on_other_mounts
from op3.diagnose.planned import planned_motions, planned_suite
from op3.diagnose.split import LogSplit, split_logs
from op3.diagnose.swing import diagnose_swings
from op3.diagnose.verdict import Finding, Verdict
from op3.diagnose.windows import WindowResiduals

__all__ = [
    "Diagnosis",
    "Finding",
    "FreeRunResiduals",
    "LogSplit",
    "Verdict",
    "WindowResiduals",
    "aliasing",
    "diagnose_swings",
    "diagnosed_mount",
    "downstream",
    "engine_for",
    "on_other_mounts",
    "planned_motions",
    "planned_suite",
    "split_logs",
    "suited",
]
