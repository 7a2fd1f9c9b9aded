"""The SDK as its user finds it."""

import dynamixel_sdk.port_handler
import pytest


@pytest.fixture(autouse=True)
def untouched_sdk(monkeypatch):
    """The SDK's own latency timer [ms], which an opened `op3.deploy.Bus` lowers for the whole process."""
    monkeypatch.setattr(dynamixel_sdk.port_handler, "LATENCY_TIMER", 16)
