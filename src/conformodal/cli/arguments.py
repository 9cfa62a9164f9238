"""Arguments and options that several verbs have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from conformodal.core.caching import default_cache_dir
from conformodal.core.files import check_writable
from conformodal.datasets import Layout

from .sources import FOLLOW_OUTSIDE

Data = Annotated[Path, typer.Argument(help="Data set: images with poses.")]
SavedModel = Annotated[Path, typer.Argument(help="Folder of a saved model.")]
DataLayout = Annotated[Layout, typer.Option("--format", help="Layout of the data set.")]
FollowOutside = Annotated[bool, typer.Option("--follow-outside", help=FOLLOW_OUTSIDE)]
Cache = Annotated[Path | None, typer.Option(help="Cache folder; ~/.cache/conformodal by default.")]


def cache_folder(cache: Path | None) -> Path:
    """The cache folder that a user named, or the usual one; it can be written."""
    folder = cache or default_cache_dir()
    check_writable(folder)
    return folder
