"""Folders that are written beside their place and moved into it when they are whole."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import DatasetError


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Write into a temporary folder beside a new or empty one, and move it into its place at the end."""
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
            part.replace(folder)  # which fails if another process has filled it
    except OSError as exc:
        raise DatasetError(f"{folder}: cannot be written: {exc}") from exc
