"""Storage of a study: a journal file, a database, or memory."""

import fcntl
import os
from pathlib import Path

import optuna
from optuna.storages import BaseStorage, InMemoryStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.storages.journal._file import BaseJournalFileLock

from op3.common.private import masked
from op3.identify.search_space import StudyError

JOURNAL_SUFFIXES = (".journal", ".log")


def open_storage(storage: str | os.PathLike[str] | None) -> BaseStorage:
    """Open the storage of a study for several concurrent workers.

    Args:
        storage: a path ending in `.journal` or `.log` (a file shared by all workers), a database URL such as
            `sqlite:///study.db` or `mysql://...`, or None for memory only.

    Raises:
        StudyError: if it is none of these, or cannot be opened or written.
    """
    if storage is None:
        return InMemoryStorage()
    name = os.fspath(storage)
    if "://" in name:
        return _open_database(name)
    if not name.endswith(JOURNAL_SUFFIXES):
        raise StudyError(
            f"The storage {name!r} is neither a journal nor a database: use a path ending in "
            f"{' or '.join(JOURNAL_SUFFIXES)}, or a URL such as sqlite:///study.db."
        )
    path = Path(name).absolute()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = _FileLock(path.with_name(path.name + ".flock"))
        lock.acquire()
        try:
            _cut_torn_record(path)
        finally:
            lock.release()
        return JournalStorage(JournalFileBackend(str(path), lock_obj=lock))
    except OSError as error:
        raise StudyError(
            f"The storage {path} cannot be written ({error.strerror or error}): "
            "choose a writable folder with storage=<path>.journal."
        ) from error
    except (ValueError, KeyError) as error:
        raise StudyError(
            f"The storage {path} is not an Optuna journal ({error}): move the file away or name another one."
        ) from error


class _FileLock(BaseJournalFileLock):
    """A lock that the kernel releases when its holder dies; Optuna's lock files remain after a kill."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor = -1

    def acquire(self) -> bool:
        """Wait for the lock."""
        self._descriptor = os.open(self._path, os.O_CREAT | os.O_RDWR, 0o666)
        fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        return True

    def release(self) -> None:
        """Release the lock."""
        os.close(self._descriptor)


def _open_database(url: str) -> BaseStorage:
    # Every database driver has other error classes, so all exceptions are caught; the cause is kept.
    try:
        return optuna.storages.get_storage(url)
    except Exception as error:
        reason = str(error).strip().splitlines()[0]
        problem = f"The storage {url!r} cannot be opened ({reason})"
        raise StudyError(f"{masked(problem)}: check the URL, its driver and the folder's permissions.") from error


def _cut_torn_record(path: Path) -> None:
    """Remove an unfinished last line, left by a full disk or a power cut, because it would corrupt the next record.

    A file that does not begin like a journal is unchanged.
    """
    with open(path, "a+b") as file:
        file.seek(0)
        content = file.read()
        if content.startswith(b'{"op_code"'):
            file.truncate(content.rfind(b"\n") + 1)
