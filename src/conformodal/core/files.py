"""Files that are read if they are files, and written whole or not at all; and the cache folder."""

from __future__ import annotations

import atexit
import errno
import glob
import os
import platform
import shutil
import tempfile
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import ConformodalError

PART = ".conformodal-part"  # ends the names of files that are not finished
_HOST = f"{zlib.crc32(platform.node().encode()):08x}"  # in these names: processes have numbers of their computer
_POINTER = b"version https://git-lfs.github.com/spec/"
_ARCHIVES = {b"PK\x03\x04": "zip", b"\x1f\x8b": "gzip", b"BZh": "bzip2", b"\xfd7zXZ\0": "xz", b"7z\xbc\xaf": "7z"}
_ARCHIVES |= {b"Rar!": "rar", b"\x28\xb5\x2f\xfd": "zstd"}


def default_cache_dir() -> Path:
    """The cache folder: ``$CONFORMODAL_CACHE``, or ``conformodal`` under the user's cache directory."""
    if "CONFORMODAL_CACHE" in os.environ:
        return Path(os.environ["CONFORMODAL_CACHE"])
    home = Path(os.path.expanduser("~"))
    home = home if home.is_absolute() else Path("/nonexistent")  # of a user that the system does not know
    return Path(os.environ.get("XDG_CACHE_HOME", home / ".cache")) / "conformodal"


def usable_cache_dir() -> Path:
    """The cache folder, created; a temporary one until the process ends where the user's cannot be written.

    Raises
    ------
    OSError
        If ``$CONFORMODAL_CACHE`` names a folder that cannot be written, or there is no temporary one.
    """
    folder = default_cache_dir()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        if "CONFORMODAL_CACHE" in os.environ:
            raise
    folder = Path(tempfile.mkdtemp(prefix="conformodal-cache-"))
    owner = os.getpid()  # workers share it
    atexit.register(lambda: shutil.rmtree(folder, ignore_errors=True) if os.getpid() == owner else None)
    os.environ["CONFORMODAL_CACHE"] = str(folder)
    return folder


def foreign_kind(content: bytes) -> str:
    """What stands in the place of a file: a pointer of Git LFS, or an archive; nothing for other content."""
    if content.startswith(_POINTER) and len(content) < 1024:
        return "is a pointer of Git LFS, not the file; fetch it by 'git lfs pull'"
    kind = next((name for mark, name in _ARCHIVES.items() if content.startswith(mark)), "")
    return f"is an archive ({kind}); unpack it, and archives in it" if kind else ""


def kind_of_file(path: Path) -> str:
    """As :func:`foreign_kind`, of the content of a file; nothing for what is not one."""
    with suppress(OSError, ValueError):
        if os.path.isfile(path):
            with path.open("rb") as file:
                return foreign_kind(file.read(1024))
    return ""


def read_file(path: Path | str) -> bytes:
    """The content of a file; an OSError for a pipe, which would be waited for, a device, a folder, a pointer of LFS."""
    if not os.path.exists(path):
        raise FileNotFoundError(errno.ENOENT, "no such file")
    if not os.path.isfile(path):
        raise OSError(errno.EINVAL, "is not a regular file")
    content = Path(path).read_bytes()
    if content.startswith(_POINTER):
        raise OSError(errno.EINVAL, foreign_kind(content) or "begins as a pointer of Git LFS")
    return content


def check_writable_file(path: Path) -> None:
    """Refuse a file that could not be written where it is to be, before the work whose result it is; makes nothing."""
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "is a folder")
        folder = next(each for each in path.absolute().parents if each.exists())
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"probe")
    except OSError as exc:
        raise ConformodalError(f"{path}: cannot be written: {exc.strerror or exc}; name another file") from exc


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file atomically: readers never see half of it, and a failure leaves the old one.

    Text that UTF-8 cannot encode, such as undecodable bytes of a file name, is written with backslashes.
    """
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    with replacing(path) as part, naming_file(path):
        part.write_bytes(data)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file to write; it replaces `path` on success and is removed on failure."""
    part = path.with_name(f".{path.name}.{_HOST}.{os.getpid()}-{threading.get_ident()}{PART}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        with naming_file(path):
            part.replace(path)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Name a file in what the system refuses about it: a full disk does not say what was being written."""
    try:
        yield
    except OSError as exc:
        exc.filename, exc.filename2 = os.fspath(path), None
        raise


def remove_leftovers(path: Path) -> None:
    """Remove what processes of this computer that were killed have left of writing a file."""
    for part in path.parent.glob(f".{glob.escape(path.name)}.{_HOST}.*{PART}"):
        process = part.name.removeprefix(f".{path.name}.{_HOST}.").partition("-")[0]
        with suppress(OSError, OverflowError):
            if process.isdigit() and os.name == "posix" and not _is_running(int(process)):
                part.unlink()


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    return True
