"""Pillow's warnings, ignored while images are decoded in several threads."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

_OF_PILLOW = r"PIL\.|conformodal\.datasets\.decoding$"
_guard = threading.Lock()
_inside: list[int] = []  # threads, once for each time that they came in
_filters = ExitStack()


@contextmanager
def ignore_pillow_warnings() -> Iterator[None]:
    """Ignore Pillow's warnings and no others.

    Python's filters belong to the whole process: threads that each restored what they had found would lose the filters
    of others, or leave warnings ignored. Only the first thread that comes in changes the filters, and the last one that
    goes out restores them.
    """
    with _guard:
        if not _inside:
            _filters.enter_context(warnings.catch_warnings())
            warnings.filterwarnings("ignore", module=_OF_PILLOW)
        _inside.append(threading.get_ident())
    try:
        yield
    finally:
        with _guard:
            _inside.pop()
            if not _inside:
                _filters.close()
