"""The table of transfers from the results of its cells."""

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
