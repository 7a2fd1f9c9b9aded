"""What the checks found in the logs that a page used."""

from collections.abc import Iterable

from op3.report.page import Page
from op3.report.traces import run_name
from op3.rollout import Rollout


def log_section(page: Page, logs: Iterable[Rollout]) -> None:
    """A table of every finding; a sentence where there is none."""
    logs = list(logs)
    found = [{"log": run_name(log), **finding.row()} for log in logs for finding in log.findings]
    rows = list(dict.fromkeys(tuple(one.values()) for one in found))
    page.section("Checks of the logs")
    if rows:
        page.table(list(found[0]), rows, "What the checks found; what was set aside was not used.")
    else:
        page.text("The checks find nothing wrong with the logs.")
