"""The table of transfers from the results of its cells."""

import pytest

from op3.common.sample_intervals import mean_interval, wilson_interval
from op3.report import read_result, write_result
from op3.report.transfer_table_page import FAILED, read_cells, write_table


def cell(folder, condition, world, seed, rounds, success):
    values = {"task": "balance", "condition": condition, "world": world, "rounds": rounds, "success": success}
    values["provenance"] = {"seed": seed}
    for number in range(rounds + 1):
        last = {"expected": 250.0, "actual": 240.0 if success else 40.0, "share": 0.96 if success else 0.16}
        last |= {"episodes": 10, "upright": 1.0 if success else 0.1}
        values |= {f"transfer_{number}.{name}": value for name, value in last.items()}
    write_result(folder / f"{condition}_{world}_{seed}" / "result.yaml", values)


def test_transfers_are_counted_by_condition_with_what_failed_beside_them(tmp_path):
    cell(tmp_path, "reidentified", "robot_7", 0, 1, True)
    cell(tmp_path, "reidentified", "robot_7", 1, 0, True)
    cell(tmp_path, "excitation_only", "robot_7", 0, 0, False)
    cell(tmp_path, "excitation_only", "robot_6", 0, 0, True)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / FAILED).write_text("no episode counts\n")
    page, numbers = write_table(read_cells(tmp_path), tmp_path)
    found = read_result(numbers)
    assert found["balance.reidentified.successes"] == 2
    assert found["balance.reidentified.at_once"] == 1
    assert found["balance.excitation_only.transfers"] == 2
    assert found["balance.excitation_only.episodes_to_their_end"] == 11
    assert found["failed.broken"] == "no episode counts"
    text = page.read_text()
    assert "2/2 (1)" in text
    assert "no episode counts" in text


def test_intervals_are_over_robots_and_differences_are_paired(tmp_path):
    """Nine cells of three robots are three trials; each robot is compared with its own second training."""
    for robot in ("a", "b", "c"):
        for seed in range(3):
            cell(tmp_path, "diagnosed", robot, seed, 1, True)
            cell(tmp_path, "retrained", robot, seed, 1, robot == "a")
    rates = read_result(write_table(read_cells(tmp_path), tmp_path)[1])
    assert rates["balance.diagnosed.successes"] == 9
    assert rates["balance.diagnosed.interval"] == pytest.approx(wilson_interval(3, 3))
    assert rates["balance.diagnosed.promise_error"] == pytest.approx([10.0, 10.0, 10.0])
    assert rates["balance.diagnosed.share_over_control"] == pytest.approx(
        [0.8 * 2 / 3, *mean_interval([0.0, 0.8, 0.8])]
    )
    assert rates["balance.retrained.share_over_control"] == pytest.approx([0.0, 0.0, 0.0])
