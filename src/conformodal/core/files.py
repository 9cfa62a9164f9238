"""Files that are read if they are files, and written whole or not at all; and the cache folder."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PART = ".conformodal-part"  # ends the names of files that are not finished


def default_cache_dir() -> Path:
    """The cache folder: ``$CONFORMODAL_CACHE``, or ``conformodal`` under the user's cache directory."""
    if "CONFORMODAL_CACHE" in os.environ:
        return Path(os.environ["CONFORMODAL_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "conformodal"


def read_file(path: Path | str) -> bytes:
    """The content of a file; an OSError for a pipe, which would be waited for, a device or a folder."""
    if not os.path.exists(path):
        raise FileNotFoundError(errno.ENOENT, "no such file")
    if not os.path.isfile(path):
        raise OSError(errno.EINVAL, "is not a regular file")
    return Path(path).read_bytes()


def write_whole(path: Path, content: bytes | str) -> None:
    """Write a file atomically: readers never see half of it, and a failure leaves the old one.

    Text that UTF-8 cannot encode, such as undecodable bytes of a file name, is written with backslashes.
    """
    data = content.encode("utf-8", "backslashreplace") if isinstance(content, str) else content
    with replacing(path) as part:
        part.write_bytes(data)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file to write; it replaces `path` on success and is removed on failure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}{PART}")
    try:
        yield part
        part.replace(path)
    except BaseException:
        with suppress(OSError):
            part.unlink()
        raise
