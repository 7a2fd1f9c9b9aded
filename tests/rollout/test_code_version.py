"""The commit of the code: found in its own repository and nowhere else."""

import subprocess
import sys

import op3.rollout.code_version as module


def test_the_commit_is_the_repositorys(monkeypatch, tmp_path):
    """In a repository of its own the commit is found, changes are seen, and elsewhere it is unknown."""
    package = tmp_path / "checkout" / "op3"
    (package / "rollout").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(module, "__file__", str(package / "rollout" / "code_version.py"))
    assert module.git_hash() is None
    assert module.git_changes() is None

    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false"]
        command = ["git", "-C", str(package), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first", "--no-verify")
    assert module.git_hash() == git("rev-parse", "HEAD")
    assert module.git_changes() is False
    (package / "__init__.py").write_text("1\n")
    assert module.git_changes() is True


def test_a_log_needs_no_figures():
    """Whoever asks for the commit, as a robot's computer does, loads no plotting library."""
    code = "import sys, op3.rollout.code_version, op3.deploy; sys.exit('plotly' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
