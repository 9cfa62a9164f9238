"""Folders that are written beside their place and moved into it when they are whole."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from conformodal.core.files import FolderInUseError, locked

from .errors import DatasetError


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Write into a temporary folder beside a new one, and move it into its place at the end."""
    try:
        folder = folder.resolve()
        if folder.exists() and not folder.is_dir():
            raise DatasetError(f"{folder}: is a file, expected a new or empty folder")
        if folder.exists() and any(folder.iterdir()):
            raise DatasetError(f"{folder}: is not empty")
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = folder.with_name(f".{folder.name}.part")
        with ExitStack() as held:
            try:
                held.enter_context(locked(folder.with_name(f".{folder.name}.lock")))
            except FolderInUseError as exc:
                raise DatasetError(f"{folder}: is being written by another process or thread") from exc
            shutil.rmtree(part, ignore_errors=True)  # of a run that was killed
            part.mkdir()
            try:
                yield part
                if folder.exists():
                    folder.rmdir()
                part.replace(folder)
            except BaseException:
                shutil.rmtree(part, ignore_errors=True)
                raise
    except OSError as exc:
        raise DatasetError(f"{folder}: cannot be written: {exc}") from exc
