"""Figures, tables, one HTML page per run (`templates/`), ``result.yaml``, and wandb; no results are computed here."""

from op3.report.page import Page
from op3.report.provenance import machine, run_provenance
from op3.report.result import RunFolder, read_result, write_result
from op3.report.run_logger import RunLogger

__all__ = ["Page", "RunFolder", "RunLogger", "machine", "read_result", "run_provenance", "write_result"]
