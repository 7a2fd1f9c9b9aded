"""Diagnosis: locates the differences of simulation and logs, names the missing effect, adds it, and measures the
gap."""

from op3.diagnose.aliasing import aliasing
from op3.diagnose.coordinates import with_chain
from op3.diagnose.diagnosis import Diagnosis
from op3.diagnose.judge_settings import Settings
from op3.diagnose.show import on_other_mounts, show
from op3.diagnose.split import LogSplit, diagnosed_mount, split_logs
from op3.diagnose.verdict import Finding, Verdict
from op3.identify.bench_model import suited
from op3.replay.windows import WindowResiduals

__all__ = [
    "Diagnosis",
    "Finding",
    "LogSplit",
    "Settings",
    "Verdict",
    "WindowResiduals",
    "aliasing",
    "diagnosed_mount",
    "on_other_mounts",
    "show",
    "split_logs",
    "suited",
    "with_chain",
]
