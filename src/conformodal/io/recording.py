"""Camera frames with times, a camera and poses, decoded when asked for; of one recording or of several joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, UInt8Array
from conformodal.geometry import PinholeCamera, PoseError, Trajectory
from conformodal.geometry.poses import concatenate

from .cameras import undistort_to
from .decoding import read_image
from .errors import DatasetError
from .reading import BETWEEN_RECORDINGS_S, Note


class ImageChange(Protocol):
    """What is done to every image that is read, such as :class:`PixelNoise`; its text tells it from others."""

    def apply(self, image: UInt8Array, name: str) -> UInt8Array:
        """The image (h, w, 3), changed; `name` is that of its file."""


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of one or more recordings by one camera.

    Attributes
    ----------
    name
        For people.
    image_paths
        One file per frame.
    timestamps_s
        (n,) seconds, strictly increasing.
    recording
        (n,) number of the recording a frame belongs to; motion is never linked across recordings.
    camera
        Intrinsics of the images as they are on disk.
    poses
        ``T_world_cam`` of all frames, or of those that have one, with their timestamps; None without poses.
    noise
        What changes images as they are read, or None.
    given_test
        (n,) whether the data set's own lists name a frame for testing; None if it has no lists.
    notes
        What is wrong or unusual: frames that were left out, frames without poses, a camera that is unlikely.
    unit
        Of positions: metres, or units of the data's own.
    """

    name: str
    image_paths: tuple[Path, ...]
    timestamps_s: FloatArray
    recording: IntArray
    camera: PinholeCamera
    poses: Trajectory | None = None
    noise: ImageChange | None = None
    given_test: BoolArray | None = None
    notes: tuple[Note, ...] = ()
    unit: str = "m"

    def __post_init__(self) -> None:
        n = len(self.image_paths)
        if n == 0:
            raise DatasetError(f"{self.name}: holds no frame")
        sizes = {"timestamps": self.timestamps_s, "recording numbers": self.recording, "given_test": self.given_test}
        for what, array in sizes.items():
            if array is not None and array.shape != (n,):
                raise DatasetError(f"{self.name}: {n} images, but {what} of shape {array.shape}")
        if self.poses is not None and len(self.poses) != len(self.posed):
            what = f"{len(self.poses)} poses have the times of {len(self.posed)} of {n} images"
            raise DatasetError(f"{self.name}: {what}; expected a pose per image, or at the times of some")
        wrong = np.flatnonzero(~np.isfinite(self.timestamps_s) | ~(np.diff(self.timestamps_s, prepend=-np.inf) > 0))
        if wrong.size:
            i = int(wrong[0])
            where = f"frame {i} ({self.image_paths[i]}) has {self.timestamps_s[i]:.9f}"
            after = f", after {self.timestamps_s[i - 1]:.9f}" if i else ""
            raise DatasetError(f"{self.name}: timestamps must be finite and increase; {where}{after}")

    def __len__(self) -> int:
        return len(self.image_paths)

    def image(self, i: int) -> UInt8Array:
        """Frame `i` as (height, width, 3) RGB."""
        path = self.image_paths[i]
        image = read_image(path, (self.camera.width, self.camera.height))
        return image if self.noise is None else self.noise.apply(image, path.name)

    @property
    def truth(self) -> Trajectory | None:
        """The poses, if every frame has one."""
        return self.poses if self.poses is not None and len(self.poses) == len(self) else None

    @property
    def posed(self) -> IntArray:
        """Indices of the frames that :attr:`poses` are of."""
        if self.poses is None or len(self.poses) == len(self):
            return np.arange(0 if self.poses is None else len(self))
        return np.flatnonzero(np.isin(self.timestamps_s, self.poses.timestamps_s))

    def require_truth(self) -> Trajectory:
        """The true poses; PoseError if a frame has none."""
        if self.truth is None:
            raise PoseError(f"{self.name}: has no poses; expected ground truth for every frame")
        return self.truth


def as_camera(sequence: Recording, camera: PinholeCamera) -> Recording:
    """The sequence as another camera would have seen it, with a note of it; what it does not show is black."""
    notes: list[Note] = []
    images = undistort_to(list(sequence.image_paths), [sequence.camera] * len(sequence), camera, notes)
    return replace(sequence, image_paths=tuple(images), camera=camera, notes=(*sequence.notes, *notes))


def join_recordings(sequences: Sequence[Recording], given_test: Sequence[bool] | None = None) -> Recording:
    """One data set from one or several, whose poses are in the same world frame.

    Recordings are numbered on. One that does not begin after the end of the one before begins 10 s after it. Images of
    other cameras than the first are brought to the first.

    One alone is returned as it is. `given_test` says which of them are held out for testing, as the split ``given``
    does it; by default, their own lists do.
    """
    if len(sequences) == 1 and given_test is None:
        return sequences[0]
    first, parts, end_s, n_recordings = sequences[0], list[Recording](), -np.inf, 0
    notes = [note for sequence in sequences for note in sequence.notes]
    for i, sequence in enumerate(sequences):
        part = sequence if sequence.camera == first.camera else as_camera(sequence, first.camera)
        notes += part.notes[len(sequence.notes) :]
        begin_s = float(part.timestamps_s[0])
        shift_s = 0.0 if begin_s > end_s else end_s + BETWEEN_RECORDINGS_S - begin_s
        part = replace(
            part,
            timestamps_s=part.timestamps_s + shift_s,
            recording=part.recording - part.recording.min() + n_recordings,
            poses=None if part.poses is None else replace(part.poses, timestamps_s=part.poses.timestamps_s + shift_s),
            given_test=part.given_test if given_test is None else np.full(len(part), given_test[i]),
        )
        parts.append(part)
        end_s, n_recordings = float(part.timestamps_s[-1]), int(part.recording.max()) + 1
    paths = [path for part in parts for path in part.image_paths]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise DatasetError(f"{twice}: is in two of the data sets; expected recordings without a common frame")
    if other := next((part for part in parts if part.poses is not None and part.unit != first.unit), None):
        raise DatasetError(f"{other.name}: has lengths in {other.unit}, and {first.name} in {first.unit}; scale one")
    poses = [part.poses for part in parts if part.poses is not None]
    listed = [np.zeros(len(part), dtype=bool) if part.given_test is None else part.given_test for part in parts]
    return Recording(
        name=" + ".join(part.name for part in parts),
        image_paths=tuple(paths),
        timestamps_s=np.concatenate([part.timestamps_s for part in parts]),
        recording=np.concatenate([part.recording for part in parts]),
        camera=first.camera,
        poses=concatenate(poses) if poses else None,
        noise=first.noise,
        given_test=None if all(part.given_test is None for part in parts) else np.concatenate(listed),
        notes=tuple(notes),
        unit=first.unit,
    )
