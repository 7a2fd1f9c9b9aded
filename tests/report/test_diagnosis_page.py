"""The page of a diagnosis, from verdicts made by hand."""

import pytest
from report_logs import PageReader, squat_log

from op3.diagnose import LogSplit, Verdict
from op3.diagnose.held_out import Gain
from op3.diagnose.verdict import Alternative, Finding, JointGap
from op3.diagnose.window_gaps import StageGap, WindowGaps
from op3.report import RunFolder
from op3.report.diagnosis_page import report_diagnosis
from op3.servo import effect_class
from op3.sim import load_model

GAIN = Gain(2.0, 0.6, 3.2, 12)
GAP = {
    "before": 0.02, "before_interval": (0.01, 0.03), "after": 0.012, "after_interval": (0.01, 0.02), "floor": None,
    "unit": "rad", "change": "less", "closure": None,
}  # fmt: skip


ANGLE = StageGap("rad", 0.02, 0.006, 0.004, 0.002, 0.1)
WINDOWS = WindowGaps(0.2, 3, {"l_knee": {"position": ANGLE}}, {"position": ANGLE}, {0.25: ANGLE})


def told(folder, *findings: Finding, flagged: bool = False) -> str:
    """The text of the page of a verdict."""
    model = load_model("paper")
    ranking = [{"effect": "backlash", "joints": ["l_knee"], "shared": False, "log_odds": 1.2}]
    verdict = Verdict(
        findings, {"l_knee": JointGap(0.02, 0.01, 0.005, 0.004, flagged, {})}, (), (), (), model, model,
        WINDOWS, {"joint/position": GAP}, ranking=ranking,
    )  # fmt: skip
    log = squat_log()
    report_diagnosis(verdict, LogSplit((log,), (log,)), verdict.plain(), RunFolder(folder, {"seed": 0}))
    return PageReader((folder / "index.html").read_text()).text


def test_a_name_comes_with_its_rival_and_what_would_tell_them_apart(tmp_path):
    """The lead says which experiment distinguishes them; size and probability are in the table; tiles have stages."""
    rival = Alternative("dte", ("l_knee",), False, 0.3)
    finding = Finding(
        "backlash", ("l_knee",), False, "backlash", 0.021, "rad", (0.015, 0.027), 0.7, 5.0, GAIN, alternatives=(rival,)
    )
    text = told(tmp_path, finding)
    assert "does not include backlash in left knee or DTE in left knee." in text
    assert "rad, probability 0.70. To distinguish it from its alternatives, record:" in text
    assert "0.021 (0.015 to 0.027) rad" in text
    assert "DTE in left knee, 0.30" in text
    assert "given model 20, baseline fit 6, repeats differ by 2" in text


@pytest.mark.parametrize("flagged", [True, False])
def test_what_was_abstained_from_is_said_first_with_what_would_settle_it(tmp_path, flagged):
    """A joint that nothing explains leaves the likeliest effect with its experiment; nothing missing names none."""
    text = told(tmp_path, flagged=flagged)
    experiment = effect_class("backlash").separating_experiment
    wanted = f"The most likely effect is backlash in left knee. To decide, record: {experiment}"
    assert (wanted in text) == flagged


def test_a_pure_number_has_no_unit(tmp_path):
    """An efficiency is 0.686 and not "0.686 -", in the sentence as in the table."""
    dte = Finding("dte", ("l_knee",), True, "backward_efficiency", 0.686, "-", (0.58, 0.791), 0.7, 5.0, GAIN)
    assert dte.phrase == "DTE (backward efficiency 0.686)"
    text = told(tmp_path, dte)
    assert "DTE: backward efficiency 0.69 (0.58 to 0.79), probability 0.70." in text
    assert "(0.58 to 0.79) -" not in text
