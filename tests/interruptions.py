"""Work that is killed, or meets a full disk, at each change that it makes to the files of a folder."""

import errno
import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from conformodal.conformal import ConformodalError

_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate")
_GROW = ("open", "os.mkdir")  # what a full disk refuses
_LEAST = 32  # bytes: joblib's semaphores are files of this size, and elsewhere than on the disk
HOW = ("killed", "full", "full while writing")
READ_ONLY = "read-only"  # from the first step on; root may write where permissions forbid it


class Killed(BaseException):
    """The process was killed: whatever its clean-up would change after that stays as it is."""


@dataclass
class Interruption:
    """How work on the files of a folder is interrupted, at a step counted from 0, and at all later ones."""

    folder: Path
    how: str
    step: int
    n_changes: int = 0
    happened: bool = False

    def meet(self, event: str, path: object) -> None:
        """A change that is about to be made."""
        counts = event in _GROW or self.how != "full"
        if not (counts and Path(os.path.abspath(os.fsdecode(path))).is_relative_to(self.folder)):
            return
        self.n_changes += 1
        if self.n_changes > self.step:
            self.happened = True
            if self.how == "killed":
                raise Killed(f"{event} {path}")
            number = errno.EROFS if self.how == READ_ONLY else errno.ENOSPC
            raise OSError(number, os.strerror(number), os.fsdecode(path))


_active: list[Interruption] = []  # at most one
_hooked: list[bool] = []


def _hook(event: str, arguments: tuple) -> None:
    """See :func:`sys.addaudithook`: an error that is raised here takes the place of the change."""
    if not _active or (event != "open" and event not in _CHANGES):
        return
    path = arguments[0]
    if isinstance(path, (str, bytes, os.PathLike)) and (event != "open" or arguments[2] & _WRITES):
        _active[0].meet(event, path)


@contextmanager
def interrupted(folder: Path, how: str, step: int) -> Iterator[Interruption]:
    """Interrupt what the block does to files in a folder at one of its steps.

    A disk that is full while files are written has room for files of so many bytes: 32, 128, 512 and so on.
    """
    if not _hooked:
        sys.addaudithook(_hook)
        _hooked.append(True)
    one = Interruption(folder.absolute(), how, step)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    if how == "full while writing":
        resource.setrlimit(resource.RLIMIT_FSIZE, (_LEAST * 4**step, limits[1]))
    else:
        _active.append(one)
    try:
        yield one
    except Killed:
        assert one.happened
    except (OSError, ConformodalError) as exc:
        cause = exc if isinstance(exc, OSError) else exc.__cause__
        if getattr(cause, "errno", None) not in (errno.ENOSPC, errno.EFBIG, errno.EROFS):
            raise
        one.happened = True
    finally:
        _active.clear()
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def each_step(most: int = 200) -> Iterator[int]:
    """Steps to interrupt at, until nothing is left to interrupt, which the loop has to break at."""
    yield from range(most)
    pytest.fail(f"more than {most} changes of files")
