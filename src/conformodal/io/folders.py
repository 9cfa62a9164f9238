"""Folders to write in: locked, so that one process writes at a time, or filled beside their place."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from conformodal.core.errors import ConformodalError
from conformodal.core.extras import require_extra
from conformodal.core.files import PART

from .errors import DatasetError

LOCK = ".lock"
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)  # some network drives


class FolderError(ConformodalError):
    """A folder to write in that cannot be used: not a folder, not writable, in use, or with something else in it."""


def check_writable(folder: Path) -> None:
    """Create a folder if it is missing, and test that something can be written in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"probe")
    except (OSError, ValueError) as exc:  # a null byte in the name is a ValueError
        raise FolderError(f"{folder}: cannot be written: {getattr(exc, 'strerror', None) or exc}") from exc


@contextmanager
def writing_in(folder: Path) -> Iterator[None]:
    """Lock a folder until the block or the process ends, and remove files that were half written.

    A folder that was created for this and stays empty is removed again.
    """
    made: list[Path] = []
    with suppress(OSError, ValueError):
        made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        check_writable(folder)
        with locked(folder / LOCK):
            for part in folder.glob(f".*{PART}"):
                part.unlink(missing_ok=True)
            yield
    finally:
        for place in made:
            with suppress(OSError, ValueError):
                place.rmdir()


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Hold a lock file with the process's number in it, re-entrant within a thread.

    The system releases the lock when the process ends, however it does.
    """
    with require_extra("run", "locking a folder"):
        from filelock import FileLock, Timeout  # noqa: PLC0415 - an extra

    lock = FileLock(file.absolute(), timeout=0, is_singleton=True)
    try:
        lock.acquire()
        file.write_text(f"{os.getpid()}\n", encoding="ascii")
    except Timeout:
        holder = file.read_text(encoding="ascii", errors="replace").strip() if file.is_file() else ""
        raise FolderError(f"{file.parent}: in use by process {holder}; wait, or name another folder") from None
    except OSError as exc:
        lock.release()
        if exc.errno not in _NO_LOCKS:
            raise FolderError(f"{file.parent}: cannot be locked: {exc.strerror}") from exc
    try:
        yield
    finally:
        if lock.lock_counter == 1:  # still held, so that no other process can lock a file that is gone
            with suppress(OSError):
                file.unlink()
        lock.release()


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Write into a temporary folder beside a new or empty one, and move it into its place at the end."""
    with scratch_beside(folder) as part:
        yield part
        part.replace(folder.resolve())  # which fails if another process has filled it


@contextmanager
def scratch_beside(folder: Path) -> Iterator[Path]:
    """A temporary folder of the same name, alone in one beside a new or empty folder, which it may replace."""
    try:
        folder = folder.resolve()
        if folder.exists() and not folder.is_dir():
            raise DatasetError(f"{folder}: is a file, expected a new or empty folder")
        if folder.exists() and any(folder.iterdir()):
            raise DatasetError(f"{folder}: is not empty")
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as scratch:
            part = Path(scratch) / folder.name
            part.mkdir()
            yield part
    except OSError as exc:
        raise DatasetError(f"{folder}: cannot be written: {exc}") from exc
