"""Optional packages: the error about a missing one says how to install it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from .errors import ConformodalError


class MissingPackageError(ConformodalError, ImportError):
    """A package that an optional part needs is not installed."""


@contextmanager
def require_extra(extra: str, what: str) -> Iterator[None]:
    """Context for the imports of an optional part.

    Parameters
    ----------
    extra
        Extra that installs the packages: ``pip install 'conformodal[EXTRA]'``.
    what
        What needs them, as the subject of a sentence.
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
