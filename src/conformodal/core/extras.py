"""Optional packages, and the error about a missing one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from .errors import ConformodalError


class MissingPackageError(ConformodalError, ImportError):
    """A package that an optional part needs is not installed."""


@contextmanager
def require_extra(extra: str, what: str) -> Iterator[None]:
    """Context for the imports of an optional part: says ``pip install 'conformodal[EXTRA]'`` if a package is missing.

    `what` needs the package; it is the subject of the message.
    """
    try:
        yield
    except ModuleNotFoundError as exc:
        package = (exc.name or "").partition(".")[0]
        if package in ("", "conformodal"):
            raise
        raise MissingPackageError(
            f"{what} needs {package}, which is not installed: pip install 'conformodal[{extra}]'"
        ) from exc
