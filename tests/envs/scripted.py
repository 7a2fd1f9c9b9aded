"""Traces that a test writes instead of a simulation."""

from typing import Any

import numpy as np

from op3.envs.step_traces import Traces


def still(steps: int, **changed: Any) -> Traces:
    """One robot that stands still without weight, but for the traces given, each ``[time, 1, ...]``."""
    one, feet = np.zeros((steps, 1)), np.zeros((steps, 1, 2))
    traces: dict[str, Any] = {name: feet for name in ("force", "sole", "slip")}
    traces |= {name: one for name in ("acceleration", "ahead", "tilt", "yaw", "penetration")}
    traces |= {"centre": np.zeros((steps, 1, 2, 2)), **changed}
    return Traces(**{name: values.astype(np.float32) for name, values in traces.items()})
