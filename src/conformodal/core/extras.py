"""Imports on first use: of optional packages, with an error that names the extra, and of a package's public names."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any

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


def lazy_getattr(package: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """A package's ``__getattr__`` (PEP 562); `names` maps public names to their modules, relative to the package."""

    def get(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(names[name], package), name)

    return get
