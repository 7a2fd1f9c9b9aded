"""What several rounds of a diagnosis add up to."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from op3.diagnose import Diagnosis
from op3.diagnose.verdict import Finding
from op3.sim import load_model


def finding(name: str, joint: str, size: float, more: float, confidence: float = 1.0) -> Finding:
    return Finding(name, (joint,), False, size, "", (size, size), confidence, {"number": more}, 0.1, "number")


def test_an_effect_is_told_once_in_its_place():
    """What a later round finds of an effect is the whole of it; to what the model had before, both are added."""
    told = cast(Any, Diagnosis)._merged(
        SimpleNamespace(given=load_model("paper")),
        [
            finding("viscous", "a", 0.09, 0.09, 0.99),
            finding("lugre", "a", 0.018, 0.018),
            finding("viscous", "b", 0.05, 0.05),
            finding("viscous", "a", 0.10, 0.01, 0.9),
            finding("lugre", "a", 0.019, 0.019),
        ],
    )
    assert [(one.name, *one.joints) for one in told] == [("viscous", "b"), ("viscous", "a"), ("lugre", "a")]
    assert [one.size for one in told] == [0.05, 0.10, 0.019]
    assert [one.parameters["number"] for one in told] == [0.05, pytest.approx(0.10), 0.019]
    assert told[1].confidence == 0.99
