"""Opening what a user names as data."""

from __future__ import annotations

from pathlib import Path

from conformodal.datasets import Layout, Sequence, read_sequence, recognise

from .console import console


def open_sequence(path: Path, layout: Layout, *, require_poses: bool) -> Sequence:
    """Read a data set in a layout; says what was recognised.

    Raises
    ------
    DatasetError
        If it is not there or not in that layout.
    """
    if layout is Layout.AUTO:
        layout = recognise(path)
        console.print(f"{path}: {layout} layout", soft_wrap=True)
    return read_sequence(path, layout, require_poses=require_poses)
