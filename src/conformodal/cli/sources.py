"""Opening what a user names as data."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

from conformodal.datasets import Sequence, read_sevenscenes


class DataFormat(StrEnum):
    """Layouts that can be read."""

    SEVENSCENES = "7scenes"


def open_sequence(path: Path, layout: DataFormat, *, require_poses: bool) -> Sequence:
    """Read a data set in a layout.

    Raises
    ------
    DatasetError
        If it is not there or not in that layout.
    """
    readers = {DataFormat.SEVENSCENES: read_sevenscenes}
    return readers[layout](path, require_poses=require_poses)
