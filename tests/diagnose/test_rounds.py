"""What several rounds of a diagnosis add up to."""

from typing import Any, cast

import pytest

from op3.diagnose.settle import Candidate, as_in, merged
from op3.diagnose.verdict import Finding, Verdict
from op3.sim import load_model


def finding(name: str, joint: str, size: float, more: float, confidence: float = 1.0) -> Finding:
    return Finding(name, (joint,), False, size, "", (size, size), confidence, {"number": more}, 0.1, "number")


def test_an_effect_is_told_once_in_its_place():
    """What a later round finds of an effect is the whole of it; to what the model had before, both are added."""
    paper = load_model("paper")
    found = [
        finding("viscous", "a", 0.09, 0.09, 0.99),
        finding("lugre", "a", 0.018, 0.018),
        finding("viscous", "b", 0.05, 0.05),
        finding("viscous", "a", 0.10, 0.01, 0.9),
        finding("lugre", "a", 0.019, 0.019),
    ]
    rounds = merged(paper, [[Candidate(one, cast(Any, None), paper)] for one in found])
    told = [candidates[0].finding for candidates in rounds]
    assert [(one.name, *one.joints) for one in told] == [("viscous", "b"), ("viscous", "a"), ("lugre", "a")]
    assert [one.size for one in told] == [0.05, 0.10, 0.019]
    assert [one.parameters["number"] for one in told] == [0.05, pytest.approx(0.10), 0.019]
    assert told[1].confidence == 0.99


def test_numbers_are_those_of_the_last_model():
    """A latency that was found before a filter has, beside it, the size of the refit with both; its width is kept."""
    given = load_model("paper_without_latency")
    final = load_model("paper").with_values({"command_latency": 0.006})
    found = Finding("latency", ("a", "b"), True, 0.004, "s", (0.003, 0.005), 1.0, {"command_latency": 0.004}, 0.5,
                    "command_latency")  # fmt: skip
    told = as_in(given, final, found, ("a", "b"))
    assert (told.size, told.parameters["command_latency"]) == (0.006, 0.006)
    assert told.interval == pytest.approx((0.005, 0.007))
    assert as_in(final, final, found, ("a", "b")) == found


@pytest.mark.parametrize(
    ("verdict", "instead", "text"),
    [
        ("named", ("", ""), "The model lacks one in a, 1 (1 to 1) and two in b, 1 (1 to 1)."),
        ("ambiguous", ("", "one"), "The model lacks one in a, 1 (1 to 1), or two in b, 1 (1 to 1); these logs do not"),
        ("ambiguous", ("", "one", ""), "one in a, 1 (1 to 1), or two in b, 1 (1 to 1), and three in c, 1 (1 to 1);"),
    ],
)
def test_a_sentence_tells_alternatives_from_what_comes_on_top(verdict, instead, text):
    """What stands for another effect is joined by or, what is found besides by and."""
    paper = load_model("paper")
    effects = tuple(
        Finding(name, (joint,), False, 1.0, "-", (1.0, 1.0), 1.0, {}, 0.1, instead_of=other)
        for name, joint, other in zip(("one", "two", "three"), "abc", instead, strict=False)
    )
    said = Verdict(verdict, effects, "", paper, paper)
    assert text in said.sentence
    assert [entry.get("instead_of", "") for entry in said.plain()["effects"]] == list(instead)
