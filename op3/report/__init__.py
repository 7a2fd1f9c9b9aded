"""Figures, tables, one HTML page per run (`templates/`), ``result.yaml``, and wandb; it computes no results."""

from op3.report.figures import errors_figure, history_figure, ranges_figure
from op3.report.page import Page
from op3.report.provenance import machine, run_provenance
from op3.report.result import RunFolder, finish, read_result, write_result
from op3.report.run_logger import RunLogger, sweep_group
from op3.report.tables import loss_table, number, parameter_table
from op3.report.traces import body_figure, run_name, runs_figure, traces_figure

__all__ = [
    "Page",
    "RunFolder",
    "RunLogger",
    "body_figure",
    "errors_figure",
    "finish",
    "history_figure",
    "loss_table",
    "machine",
    "number",
    "parameter_table",
    "ranges_figure",
    "read_result",
    "run_name",
    "run_provenance",
    "runs_figure",
    "sweep_group",
    "traces_figure",
    "write_result",
]
