"""The page of compliance, from measurements made by hand."""

import numpy as np

from op3.compliance.backdrive import BackDrive
from op3.compliance.compare import difference
from op3.compliance.compliance_study import Measured
from op3.compliance.energy import Energy
from op3.compliance.gains import BINS, SITUATIONS, Gains
from op3.compliance.landing import Landings
from op3.compliance.leading import Led
from op3.compliance.pushing import Survival
from op3.compliance.robustness import Passed
from op3.report import RunFolder, read_result
from op3.report.compliance_page import report_compliance
from tests.op3_table import CONTROLLED_JOINTS, JOINTS


def measured(label: str, force: float, rungs: int, successes: int) -> Measured:
    """A policy with 200 landings about a force [N], that survives the pushes up to a rung."""
    noise = np.random.default_rng(0).standard_normal(200)
    level = np.array([1.0, 0.9, 1.1])
    survived = np.zeros((8, 10, 5), dtype=bool)
    survived[:, :rungs] = True
    same, moved = np.full(200, 0.2), np.array([[0.1, 0.0, 0.2], [np.nan] * 3])
    return Measured(
        label=label,
        passed={"walk": Passed(50, 50, 50, 0.25), "walk_bricks_a": Passed(50, 50, successes, 0.25)},
        landings=Landings(np.arange(200) // 10, force + noise, noise + 40, same, same / 10),
        survival=Survival(0.3 * (np.arange(10) + 0.5), survived),
        led={"trunk forwards": Led(np.array([1.0, 2.0]), moved, np.array([1.0, 0.0]))},
        energy=Energy(level, level, np.full(20, 0.2), np.full(20, 30.0), JOINTS, 0.01, 0.46),
        back_drive=BackDrive(np.full((2, 10, 2), 0.3), np.full((2, 10, 2), 4.0), CONTROLLED_JOINTS),
        gains=Gains(
            (np.arange(BINS) + 0.5) / BINS, np.ones((10, BINS)), np.ones((10, BINS, 2)), np.ones((10, BINS)), level,
            {name: np.tile(level, (10, 1)) for name in SITUATIONS}, level, -level, np.full(10, 2.1), CONTROLLED_JOINTS,
        ),
    )  # fmt: skip


def test_page_and_numbers(tmp_path):
    """The first policy lands 20 N softer, survives 0.9 N s more and passes all bricks where the other passes half."""
    first, other = measured("soft", 100.0, 7, 50), measured("stiff one", 120.0, 4, 25)
    report_compliance(
        [first, other], {other.label: difference(first, other)}, {"hold": first.energy}, RunFolder(tmp_path, {})
    )
    numbers = read_result(tmp_path / "result.yaml")
    assert abs(numbers["difference.stiff_one.force"][0] + 20) < 0.5
    assert abs(numbers["difference.stiff_one.push"][0] - 0.9) < 1e-9
    assert numbers["difference.stiff_one.bricks"][0] == 0.5
    assert numbers["led.soft.trunk_forwards.fall_force"] == 2.0
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "it lands more softly, passes more episodes on uneven ground, withstands larger pushes than" in page
