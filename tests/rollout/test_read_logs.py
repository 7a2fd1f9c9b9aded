"""Finding logs: folders, patterns, lists."""

from __future__ import annotations

import pytest
from rollout_logs import rollout

from op3.rollout import LogError, read_log, read_logs


@pytest.fixture
def shelf(tmp_path):
    """A folder with two rollouts and two CSV files, written out of order."""
    for name, rows in (("b", 6), ("a", 5)):
        rollout(rows).save(tmp_path / name)
    for name, rows in (("d", 8), ("c", 7)):
        rollout(rows).to_csv(tmp_path / f"{name}.csv")
    (tmp_path / "notes.txt").write_text("not a log")
    (tmp_path / "model.json").write_text("{}")
    (tmp_path / ".hidden").mkdir()
    return tmp_path


def test_a_folder_gives_its_logs_sorted(shelf):
    """Rollouts and CSV files of a folder come sorted by name; other files are passed over."""
    assert [log.rows for log in read_logs(shelf)] == [5, 6, 7, 8]


def test_patterns_lists_and_single_logs(shelf):
    """A pattern is sorted, a list keeps its order, a single log is a list of one."""
    assert [log.rows for log in read_logs(shelf / "*.csv")] == [7, 8]
    assert [log.rows for log in read_logs([shelf / "d.csv", str(shelf / "a")])] == [8, 5]
    assert [log.rows for log in read_logs(str(shelf / "b"))] == [6]


def test_one_bad_log_refuses_all(shelf):
    """A folder with a broken log is not half read."""
    (shelf / "c.yaml").unlink()
    with pytest.raises(LogError, match=r"c\.yaml"):
        read_logs(shelf)


def test_nothing_found_says_what_was_looked_for(tmp_path):
    """Empty folders, patterns, lists and missing files are refused with what may be named."""
    (tmp_path / "empty").mkdir()
    for paths in (tmp_path / "empty", tmp_path / "*.csv", []):
        with pytest.raises(LogError, match=r"a rollout folder, a wide \.csv"):
            read_logs(paths)
    with pytest.raises(LogError, match=r"no\.csv: there is no such file or folder"):
        read_logs(tmp_path / "no.csv")


def test_single_log_kinds(shelf):
    """A folder that holds no log, an unknown ending and metadata.yaml itself are recognised."""
    with pytest.raises(LogError, match=r"no metadata\.yaml"):
        read_log(shelf)
    with pytest.raises(LogError, match=r"'\.txt' is not a log format"):
        read_log(shelf / "notes.txt")
    assert read_log(shelf / "a" / "metadata.yaml").rows == 5


def test_a_folder_without_logs_gives_those_of_its_folders(tmp_path):
    """What a multirun leaves, a folder for every job, is read as one; hidden folders are not."""
    for place, rows in (("1/a", 5), ("0/b", 6), (".hidden/c", 7)):
        rollout(rows).save(tmp_path / place)
    assert [log.rows for log in read_logs(tmp_path)] == [6, 5]
