"""The commit of the code that produced a log or a result."""

import subprocess
from pathlib import Path


def git_hash() -> str | None:
    """Commit of this package's repository; None if it is not in one."""
    folder = _package()
    try:
        # a package installed inside another project's repository must not report that project's commit
        _git(folder, "ls-files", "--error-unmatch", "__init__.py")
        return _git(folder, "rev-parse", "HEAD")
    except (OSError, subprocess.SubprocessError):
        return None


def git_changes() -> bool | None:
    """Whether tracked files differ from the commit; None if the package is not in its own repository."""
    if git_hash() is None:
        return None
    try:
        return bool(_git(_package(), "status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None


def _package() -> Path:
    return Path(__file__).resolve().parents[1]


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
