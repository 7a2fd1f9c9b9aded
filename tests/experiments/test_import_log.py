"""The import's script as a user runs it."""

import pytest

from tests.rollout.rollout_logs import rollout
from tests.scripts import run_script


@pytest.mark.parametrize(
    ("option", "code", "said"),
    [
        ("", 1, "write `split: true` into the log's YAML"),
        ("split: true", 0, "part-1: 100 rows"),
        ("scale: {l_knee.velocty: 2}", 1, "l_knee.velocty is not in the log; rename it to l_knee.velocity"),
    ],
)
def test_options_in_the_yaml_count(tmp_path, option, code, said):
    """What a finding says should be written there mends the log for the import as well."""
    path = rollout(rows=300).to_csv(tmp_path / "run.csv")
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([header, *rows[:100], *rows[200:300]]))
    with path.with_suffix(".yaml").open("a") as side:
        side.write(f"{option}\n")
    done = run_script("import_log.py", f"data={path}")
    assert (done.returncode, said in done.stdout) == (code, True), done.stdout


def test_a_log_without_a_yaml_is_shown_where_none_can_be_written(tmp_path):
    """What was understood of it is used; the YAML has to lie elsewhere. Nor is one needed with `write=false`."""
    path = rollout(rows=300).to_csv(tmp_path / "run.csv")
    path.with_suffix(".yaml").unlink()
    done = run_script("import_log.py", f"data={path}", "write=false")
    assert "run: 300 rows" in done.stdout
    assert not path.with_suffix(".yaml").exists()
    path.with_suffix(".yaml").mkdir()  # in whose place nobody can write a file, not even root
    done = run_script("import_log.py", f"data={path}")
    assert "run: 300 rows" in done.stdout
    assert "is a directory; copy the log to a folder" in done.stderr
