"""Passwords and the user's paths stay on the user's machine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from op3.common.private import hide, scrub

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        ("storage=postgresql://me:s3cret@host/db", "storage=postgresql://me:***@host/db"),
        ("{'storage': 'mysql+pymysql://me:s3cret@h:3306/db'}", "{'storage': 'mysql+pymysql://me:***@h:3306/db'}"),
        ("storage=postgresql://me:s3/cr@et@host/db", "storage=postgresql://me:***@host/db"),
        ("api_key=abcdef123", "api_key=***"),
        ("wandb_key=abcdef123 and passphrase: abcdef", "wandb_key=*** and passphrase: ***"),
        ("Authorization: Bearer abcdef", "Authorization: Bearer ***"),
        ("run.yaml: unexpected token: abcdef on line 3", "run.yaml: unexpected token: abcdef on line 3"),
        ("unexpected token '=' near abcdef", "unexpected token '=' near abcdef"),
        ("seed: 1\n  token: abcdef\nhub_token: abcdef", "seed: 1\n  token: ***\nhub_token: ***"),
        ("with token=abcdef and {'token': 'abcdef'}", "with token=*** and {'token': '***'}"),
        ("mysql://host/db?pw=abcdef&ssl=1", "mysql://host/db?pw=***&ssl=1"),
        ("db?password=$ecret1", "db?password=$***"),
        ("db?password=${oc.env:OP3_SECRET_7}", "db?password=${oc.env:OP3_SECRET_7}"),
        ("sqlite:////tmp/someone/runs/study.db", "sqlite:///.../runs/study.db"),
        ("data=/tmp/someone/logs/squat.csv", "data=.../logs/squat.csv"),
        ("rate 3/4 and https://example.org/a/b", "rate 3/4 and https://example.org/a/b"),
        (f"model={Path.cwd()}/outputs/a/model.yaml", "model=outputs/a/model.yaml"),
    ],
)
def test_secrets_and_paths_are_taken_out(text, clean):
    """What else a text says stays as it is."""
    assert scrub(text) == clean
    assert scrub({"a": [text]}) == {"a": [clean]}


def test_a_password_of_the_command_line_stays_in_the_environment(monkeypatch):
    """The setting refers to it, and what is written with it is masked."""
    for name in [name for name in os.environ if name.startswith("OP3_SECRET_")]:
        monkeypatch.delenv(name)
    assert (
        hide("storage='postgresql://me:s3cret@host/db'") == "storage='postgresql://me:${oc.env:OP3_SECRET_0}@host/db'"
    )
    assert os.environ.pop("OP3_SECRET_0") == "s3cret"


def test_runs_of_one_second_have_folders_of_their_own_without_secrets(tmp_path):
    """Two recordings begun together are both there, and no file of theirs holds a path or a password."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "WANDB_API_KEY": ""}
    command = [
        sys.executable,
        str(ROOT / "experiments" / "collect.py"),
        "motion=hold",
        "motion.duration=1",
        "+note=ftp://me:s3cret@host/x",
    ]
    runs = [
        subprocess.Popen([*command, f"seed={seed}"], cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)
        for seed in (0, 1)
    ]
    for run in runs:
        assert run.wait() == 0, run.stderr.read() if run.stderr else ""
    folders = [path for path in (tmp_path / "outputs" / "collect").iterdir()]
    assert len(folders) == 2
    for file in (tmp_path / "outputs").rglob("*"):
        if file.is_file():
            text = file.read_bytes()
            assert b"s3cret" not in text, file
            assert str(tmp_path).encode() not in text, file
            assert str(ROOT).encode() not in text, file
