"""What the experiment scripts share."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra.errors import CompactHydraException


@contextmanager
def one_sentence() -> Iterator[None]:
    """Let wrong input end a script with its one sentence and a non-zero exit, without a stack trace."""
    try:
        yield
    except (ValueError, FileNotFoundError) as error:
        raise CompactHydraException(str(error)) from error
    except KeyboardInterrupt:
        print(
            "\nInterrupted. The same command with the same hydra.run.dir goes on from the trials done.", file=sys.stderr
        )
        raise SystemExit(130) from None


def git_hash() -> str | None:
    """The commit of this checkout, None outside one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip() or None
    except (OSError, subprocess.CalledProcessError):
        return None
