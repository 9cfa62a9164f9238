"""Arguments and options that several verbs have, and the folders that these name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from conformodal.core.files import check_writable
from conformodal.datasets import Layout
from conformodal.odometry.results.folders import check_no_stray, claimed
from conformodal.vision import default_cache_dir

from .sources import FOLLOW_OUTSIDE

Data = Annotated[Path, typer.Argument(help="Data set: images with poses.")]
SavedModel = Annotated[Path, typer.Argument(help="Folder of a saved model.")]
DataLayout = Annotated[Layout, typer.Option("--format", help="Layout of the data set.")]
FollowOutside = Annotated[bool, typer.Option("--follow-outside", help=FOLLOW_OUTSIDE)]
Cache = Annotated[Path | None, typer.Option(help="Cache folder; ~/.cache/conformodal by default.")]


@contextmanager
def results_folder(out: Path, command: str, apart: Iterable[Path] = ()) -> Iterator[None]:
    """Have a folder for a command's results, in which no file of anyone else would be lost.

    Raises
    ------
    FolderError
        See :func:`~conformodal.odometry.results.folders.claimed` and
        :func:`~conformodal.odometry.results.folders.check_no_stray`.
    """
    with claimed(out, command, apart):
        check_no_stray(out, command)
        yield


def cache_folder(cache: Path | None) -> Path:
    """The cache folder that a user named, or the usual one; it can be written.

    Raises
    ------
    FolderError
        If it cannot be written.
    """
    folder = cache or default_cache_dir()
    check_writable(folder)
    return folder
