"""A sequence of camera frames: paths to images, decoded when asked for, with timestamps, camera and poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from zlib import crc32

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, UInt8Array
from conformodal.core.ranges import check_ranges
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


@dataclass(frozen=True)
class PixelNoise:
    """Gaussian noise on every pixel and channel of the image as the camera delivers it (the paper, table 1).

    Attributes
    ----------
    sigma
        Standard deviation where pixels are in [0, 1].
    seed
        Of the noise; every frame has its own by its name.

    Raises
    ------
    DatasetError
        If `sigma` is negative or not finite.
    """

    sigma: float
    seed: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sigma) and self.sigma >= 0):
            raise DatasetError(f"noise needs a standard deviation of at least 0, got {self.sigma}")
        check_ranges({"seed": self.seed}, DatasetError)

    @property
    def changes(self) -> bool:
        """Whether images change."""
        return self.sigma > 0

    def apply(self, image: UInt8Array, name: str) -> UInt8Array:
        """The noisy image (h, w, 3), cut off at black and white and rounded, as a camera would."""
        if not self.changes:
            return image
        rng = np.random.default_rng([self.seed, crc32(name.encode())])
        noisy = rng.standard_normal(image.shape, dtype=np.float32)
        noisy *= 255 * self.sigma
        noisy += image
        np.rint(noisy, out=noisy)
        return np.clip(noisy, 0, 255, out=noisy).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of one or more recordings by one camera.

    Attributes
    ----------
    name
        For people.
    image_paths
        One file a frame.
    timestamps_s
        (n,) seconds, strictly increasing.
    recording
        (n,) number of the recording a frame belongs to; motion is never linked across recordings.
    camera
        Intrinsics of the images as they are on disk.
    truth
        Poses ``T_world_cam``, or None.
    noise
        What changes images as they are read, or None.
    given_test
        (n,) whether the data set's own lists name a frame for testing; None if it has no lists.
    known_poses
        Poses of the frames that have one, where not all have, with those frames' timestamps; else as `truth`.
    notes
        What the reader found wrong: frames that it left out, frames without poses, a camera that is unlikely.
    """

    name: str
    image_paths: tuple[Path, ...]
    timestamps_s: FloatArray
    recording: IntArray
    camera: PinholeCamera
    truth: Trajectory | None = None
    noise: ImageChange | None = None
    given_test: BoolArray | None = None
    known_poses: Trajectory | None = None
    notes: tuple[Note, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.image_paths)
        if n == 0:
            raise DatasetError(f"{self.name}: holds no frame")
        if self.timestamps_s.shape != (n,) or self.recording.shape != (n,):
            raise DatasetError(f"{self.name}: {n} images, but {len(self.timestamps_s)} timestamps")
        if not np.isfinite(self.timestamps_s).all():
            i = int(np.flatnonzero(~np.isfinite(self.timestamps_s))[0])
            raise DatasetError(f"{self.name}: frame {i} ({self.image_paths[i]}) has time {self.timestamps_s[i]}")
        if not (np.diff(self.timestamps_s) > 0).all():
            i = int(np.flatnonzero(np.diff(self.timestamps_s) <= 0)[0]) + 1
            raise DatasetError(f"{self.name}: timestamps must increase; frame {i} ({self.image_paths[i]}) goes back")
        if self.truth is not None and len(self.truth) != n:
            raise DatasetError(f"{self.name}: {n} images, but {len(self.truth)} poses")
        if self.given_test is not None and self.given_test.shape != (n,):
            raise DatasetError(f"{self.name}: {n} images, but given_test has shape {self.given_test.shape}")

    def __len__(self) -> int:
        return len(self.image_paths)

    def image(self, i: int) -> UInt8Array:
        """Frame `i` as (height, width, 3) RGB.

        Raises
        ------
        ImageError
            If the file cannot be decoded, or its size is not the camera's.
        """
        path = self.image_paths[i]
        image = read_image(path, (self.camera.width, self.camera.height))
        return image if self.noise is None else self.noise.apply(image, path.name)

    @property
    def poses(self) -> Trajectory | None:
        """The poses that are known: of all frames, or of those that have one."""
        return self.known_poses if self.truth is None else self.truth

    @property
    def posed(self) -> IntArray:
        """Indices of the frames that :attr:`poses` are of.

        Raises
        ------
        DatasetError
            If a known pose has the time of no frame.
        """
        if self.truth is not None or self.known_poses is None:
            return np.arange(0 if self.truth is None else len(self))
        found = np.flatnonzero(np.isin(self.timestamps_s, self.known_poses.timestamps_s))
        if len(found) != len(self.known_poses):
            raise DatasetError(
                f"{self.name}: {len(self.known_poses)} known poses have the times of {len(found)} frames"
            )
        return found

    def require_truth(self) -> Trajectory:
        """The true poses.

        Raises
        ------
        PoseError
            If the sequence has none.
        """
        if self.truth is None:
            raise PoseError(f"{self.name}: has no poses; expected ground truth for every frame")
        return self.truth
