"""Notebooks are tests; the one on real recordings needs those."""

import os
from pathlib import Path

import pytest

XL330_LOGS = Path(__file__).parents[2] / "shared" / "data" / "servo_bench" / "xl330"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Both longer notebooks are slow; without the recordings theirs is skipped."""
    for item in items:
        if item.path.name in ("real_servo.ipynb", "train_your_own.ipynb"):
            item.add_marker(pytest.mark.slow)
        if item.path.name == "real_servo.ipynb" and not XL330_LOGS.is_dir():
            item.add_marker(pytest.mark.skip(reason=f"the recordings are not at {XL330_LOGS}"))
    os.environ.setdefault("XL330_LOGS", str(XL330_LOGS))
