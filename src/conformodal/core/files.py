"""Atomic writes of files, and locks on folders that one process writes at a time; the standard library alone."""

from __future__ import annotations

import errno
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import ConformodalError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LOCK, PART = ".lock", ".conformodal-part"
_LEAST_FREE, _PROBE = 1 << 20, 1 << 16  # bytes
_BUSY = (errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK, errno.EDEADLK)
# Locks of this process by their files: which thread has them, and how often.
_held: dict[Path, tuple[int, int]] = {}
_guard = threading.Lock()


class FolderError(ConformodalError):
    """A folder to write in that cannot be used: no folder, not writable, in use, or with something else in it."""


class FolderInUseError(FolderError):
    """A folder that another process, or another thread, is writing in."""


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file beside its place and move it there: no reader sees half of it, and a failure leaves the old one.

    Text that UTF-8 cannot encode, such as undecodable bytes of a file name, is written with backslashes.
    """
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    with replacing(path) as part:
        part.write_bytes(data)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside `path` to be written; it takes the place of `path` if all goes well, and is removed if not."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}{PART}")
    try:
        yield part
        part.replace(path)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise


def check_writable(folder: Path) -> None:
    """Make a folder if it is missing, and write to it for a test.

    Raises
    ------
    FolderError
        If it is no folder, cannot be made or written, or its disk is full.
    """
    try:
        for place in (folder, *folder.parents):
            if place.exists() or place.is_symlink():
                if not place.is_dir():
                    raise FolderError(f"{folder}: must be a folder, but {place} is a file or a broken link")
                break
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(_PROBE))
            probe.flush()
        free = shutil.disk_usage(folder).free
    except OSError as exc:
        raise FolderError(f"{folder}: cannot be written: {exc.strerror}") from exc
    except ConformodalError:
        raise
    except ValueError as exc:  # a null byte
        raise FolderError(f"{str(folder)!r}: is no name of a folder: {exc}") from exc
    if free < _LEAST_FREE:
        raise FolderError(f"{folder}: the disk is full: {free} bytes are free, at least {_LEAST_FREE} are needed")


@contextmanager
def writing_in(folder: Path) -> Iterator[None]:
    """Reserve a folder: check it, lock it until the block or the process ends, remove files that were half written.

    A folder that was made for this and stays empty is removed again.

    Raises
    ------
    FolderInUseError
        If another process or thread has it.
    FolderError
        See :func:`check_writable`.
    """
    made = _missing(folder)
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


def _missing(folder: Path) -> list[Path]:
    try:
        return [place for place in (folder, *folder.parents) if not place.exists()]
    except (OSError, ValueError):
        return []


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Hold a lock file with the process's number in it. One thread may hold it several times over.

    The system releases the lock when the process ends, however it does.

    Raises
    ------
    FolderInUseError
        If another process or thread holds it.
    """
    key, me = file.absolute(), threading.get_ident()
    with _guard:
        thread, count = _held.get(key, (me, 0))
        if thread != me:
            raise FolderInUseError(f"{file.parent}: another thread of this process is writing there")
        handle = None if count else _take(file)
        _held[key] = (me, count + 1)
    try:
        yield
    finally:
        with _guard:
            _held[key] = (me, _held[key][1] - 1)
            if handle is not None:
                del _held[key]
                with suppress(OSError):  # no other process holds it: one that opened it earlier compares the file again
                    file.unlink()
                os.close(handle)


def _take(file: Path) -> int:
    while True:
        try:
            handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as exc:
            raise FolderError(f"{file.parent}: cannot be locked: {exc.strerror}") from exc
        try:
            _lock(handle)
            same = os.path.samestat(os.fstat(handle), file.stat())
            if same:
                os.ftruncate(handle, 0)
                os.write(handle, f"{os.getpid()}\n".encode())
                return handle
        except FileNotFoundError:  # the process that held the lock has just removed the file
            pass
        except OSError as exc:
            os.close(handle)
            if exc.errno in _BUSY:
                raise FolderInUseError(f"{file.parent}: in use by {_holder(file)}; wait, or take another one") from None
            raise FolderError(f"{file.parent}: cannot be locked: {exc.strerror}") from exc
        os.close(handle)


def _holder(file: Path) -> str:
    try:
        number = file.read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        number = ""
    return f"process {number}" if number.isdecimal() else "another process"


if sys.platform == "win32":

    def _lock(handle: int) -> None:
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)

else:

    def _lock(handle: int) -> None:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as exc:
            if exc.errno not in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS):  # a disk that knows no locks
                raise
