"""Opening what a user names as data."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from conformodal.datasets import DatasetError, Layout, Sequence, read_sequence, recognise
from conformodal.datasets.streams import FrameStream, SequenceStream, open_stream
from conformodal.poses import PinholeCamera

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


def open_source(
    source: str,
    layout: Layout,
    *,
    camera: PinholeCamera | None = None,
    topic: str | None = None,
    as_trained: bool = False,
) -> FrameStream:
    """Open anything that gives frames, see :func:`~conformodal.datasets.streams.open_stream`; says what it is.

    With `as_trained`, a data set where only some frames have poses is read as for training: without the others.

    Raises
    ------
    DatasetError
        If it cannot be opened.
    """
    stream = open_stream(source, layout, camera=camera, topic=topic)
    if as_trained and isinstance(stream, SequenceStream) and stream.sequence.truth is None:
        with suppress(DatasetError):  # no frame has a pose
            stream = SequenceStream(read_sequence(Path(source), layout, require_poses=True))
    if isinstance(stream, SequenceStream):
        kind = recognise(Path(source)) if layout is Layout.AUTO else layout
        poses = "without poses, or not for every frame" if stream.sequence.truth is None else "with poses"
        console.print(f"{source}: {kind} layout, {len(stream.sequence)} frames {poses}", soft_wrap=True)
    else:
        count = "" if stream.n_frames is None else f", {stream.n_frames} frames"
        console.print(f"{stream.name}: {type(stream).__name__.removesuffix('Stream').lower()}{count}", soft_wrap=True)
    return stream
