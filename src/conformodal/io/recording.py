"""A sequence of camera frames: paths to images, decoded when asked for, with timestamps, camera and poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, UInt8Array
from conformodal.geometry import PinholeCamera, PoseError, Trajectory

from .decoding import read_image
from .errors import DatasetError
from .reading import Note


class ImageChange(Protocol):
    """What is done to every image that is read, such as :class:`PixelNoise`; its text tells it from others."""

    @property
    def changes(self) -> bool:
        """Whether images change."""

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

    def __post_init__(self) -> None:
        n = len(self.image_paths)
        if n == 0:
            raise DatasetError(f"{self.name}: holds no frame")
        sizes = {"timestamps": self.timestamps_s, "recording numbers": self.recording, "given_test": self.given_test}
        for what, array in sizes.items():
            if array is not None and array.shape != (n,):
                raise DatasetError(f"{self.name}: {n} images, but {what} of shape {array.shape}")
        if self.poses is not None and len(self.poses) != len(self.posed):
            raise DatasetError(
                f"{self.name}: {len(self.poses)} poses have the times of {len(self.posed)} of {n} images; expected one "
                "pose per image, or poses at the images' times"
            )
        wrong = np.flatnonzero(~np.isfinite(self.timestamps_s) | ~(np.diff(self.timestamps_s, prepend=-np.inf) > 0))
        if wrong.size:
            i = int(wrong[0])
            where = f"frame {i} ({self.image_paths[i]}) has {self.timestamps_s[i]}"
            raise DatasetError(f"{self.name}: timestamps must be finite and increase; {where}")

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
