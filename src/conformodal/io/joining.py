"""Several recordings, or several streams, as one: numbered on, and one after the other in time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from conformodal.core.arrays import BoolArray
from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.geometry.poses import concatenate

from .errors import DatasetError
from .lenses import as_camera
from .reading import BETWEEN_RECORDINGS_S, Note
from .recording import Recording
from .streams.frames import Frame, FrameStream, SourceError
from .streams.stored import RecordingStream


def join_recordings(sequences: Sequence[Recording], given_test: Sequence[bool] | None = None) -> Recording:
    """One data set from one or several, whose poses are in the same world frame.

    Recordings are numbered on. One that does not begin after the end of the one before begins 10 s after it. Images of
    other cameras than the first are brought to the first.

    Parameters
    ----------
    sequences
        At least one; one alone is returned as it is.
    given_test
        Which of them are held out for testing, as the split ``given`` does it; by default, their own lists say it.
    """
    if not sequences:
        raise DatasetError("no data set was given, expected at least one")
    if len(sequences) == 1 and given_test is None:
        return sequences[0]
    first, notes = sequences[0], [note for sequence in sequences for note in sequence.notes]
    paths: list[str] = []
    parts: list[Recording] = []
    end_s, n_recordings = -np.inf, 0
    for i, sequence in enumerate(sequences):
        part = sequence if sequence.camera == first.camera else as_camera(sequence, first.camera)
        notes += part.notes[len(sequence.notes) :]
        if twice := set(paths).intersection(map(str, part.image_paths)):
            raise DatasetError(f"{min(twice)}: is in two of the data sets; expected recordings without a common frame")
        paths += map(str, part.image_paths)
        shift_s = _shift_s(float(part.timestamps_s[0]), end_s)
        recording = part.recording - part.recording.min() + n_recordings
        test = part.given_test if given_test is None else np.full(len(part), given_test[i])
        parts.append(
            replace(
                part,
                timestamps_s=part.timestamps_s + shift_s,
                recording=recording,
                poses=_shifted(part.poses, shift_s),
                given_test=test,
            )
        )
        end_s, n_recordings = float(parts[-1].timestamps_s[-1]), int(recording.max()) + 1
    poses = [part.poses for part in parts if part.poses is not None]
    return Recording(
        name=" + ".join(part.name for part in parts),
        image_paths=tuple(path for part in parts for path in part.image_paths),
        timestamps_s=np.concatenate([part.timestamps_s for part in parts]),
        recording=np.concatenate([part.recording for part in parts]),
        camera=first.camera,
        poses=concatenate(poses) if poses else None,
        noise=first.noise,
        given_test=_test_frames(parts),
        notes=tuple(notes),
    )


def _shift_s(begin_s: float, end_s: float) -> float:
    """What is added to times that begin at `begin_s`, after a recording that ends at `end_s`."""
    return 0.0 if begin_s > end_s else end_s + BETWEEN_RECORDINGS_S - begin_s


def _shifted(poses: Trajectory | None, shift_s: float) -> Trajectory | None:
    return None if poses is None else replace(poses, timestamps_s=poses.timestamps_s + shift_s)


def _test_frames(parts: Sequence[Recording]) -> BoolArray | None:
    if all(part.given_test is None for part in parts):
        return None
    return np.concatenate([np.zeros(len(p), dtype=bool) if p.given_test is None else p.given_test for p in parts])


@dataclass(frozen=True, eq=False)
class JoinedStream:
    """Streams one after the other, joined as :func:`join_recordings` joins data sets; see :func:`join_streams`."""

    streams: tuple[FrameStream, ...]
    name: str
    camera: PinholeCamera | None
    n_frames: int | None
    notes: tuple[Note, ...]
    live = False

    def __iter__(self) -> Iterator[Frame]:
        """Decode frame after frame."""
        end_s, n_recordings = -np.inf, 0
        for stream in self.streams:
            last_s, last_recording, shift_s = end_s, n_recordings, None
            for frame in stream:
                shift_s = _shift_s(frame.timestamp_s, end_s) if shift_s is None else shift_s
                time_s, recording = frame.timestamp_s + shift_s, frame.recording + n_recordings
                last_s, last_recording = max(last_s, time_s), max(last_recording, recording)
                yield replace(frame, timestamp_s=time_s, recording=recording, index=-1)
            end_s, n_recordings = last_s, last_recording + 1


def join_streams(streams: Sequence[FrameStream]) -> FrameStream:
    """One stream from at least one; data sets alone become one data set, with their poses."""
    if len(streams) == 1:
        return streams[0]
    if endless := next((stream for stream in streams if stream.live), None):
        raise SourceError(f"{endless.name}: never ends, so it cannot be one of several sources")
    data_sets = [stream.sequence for stream in streams if isinstance(stream, RecordingStream)]
    if len(data_sets) == len(streams):
        return RecordingStream(join_recordings(data_sets))
    counts = [stream.n_frames for stream in streams]
    return JoinedStream(
        tuple(streams),
        name=" + ".join(stream.name for stream in streams),
        camera=next((stream.camera for stream in streams if stream.camera is not None), None),
        n_frames=None if None in counts else sum(count or 0 for count in counts),
        notes=tuple(note for stream in streams for note in stream.notes),
    )
