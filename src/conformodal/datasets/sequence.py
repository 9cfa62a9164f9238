"""A sequence of camera frames: paths to images, decoded when asked for, with timestamps, camera and poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from conformodal.poses import PinholeCamera, PoseError, Trajectory

from .errors import DatasetError, ImageError
from .noise import PixelNoise

IntArray = npt.NDArray[np.int64]


def read_image(path: Path) -> npt.NDArray[np.uint8]:
    """Decode an image whole, as (height, width, 3) RGB.

    Raises
    ------
    ImageError
        If the file is missing, truncated or no image. (Pillow refuses truncated files; some decoders fill the
        rest with grey in silence.)
    """
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except FileNotFoundError:
        raise ImageError(f"{path}: image is missing") from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as exc:
        raise ImageError(f"{path}: cannot be decoded as an image: {exc}") from exc


@dataclass(frozen=True, eq=False)
class Sequence:
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
        Noise that images are read with, or None.
    given_test
        (n,) whether the data set's own lists name a frame for testing; None if it has no lists.
    """

    name: str
    image_paths: tuple[Path, ...]
    timestamps_s: npt.NDArray[np.float64]
    recording: IntArray
    camera: PinholeCamera
    truth: Trajectory | None = None
    noise: PixelNoise | None = None
    given_test: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        n = len(self.image_paths)
        if n == 0:
            raise DatasetError(f"{self.name}: holds no frame")
        if self.timestamps_s.shape != (n,) or self.recording.shape != (n,):
            raise DatasetError(f"{self.name}: {n} images, but {len(self.timestamps_s)} timestamps")
        if not (np.diff(self.timestamps_s) > 0).all():
            i = int(np.flatnonzero(np.diff(self.timestamps_s) <= 0)[0]) + 1
            raise DatasetError(f"{self.name}: timestamps must increase; frame {i} ({self.image_paths[i]}) goes back")
        if self.truth is not None and len(self.truth) != n:
            raise DatasetError(f"{self.name}: {n} images, but {len(self.truth)} poses")
        if self.given_test is not None and self.given_test.shape != (n,):
            raise DatasetError(f"{self.name}: {n} images, but given_test has shape {self.given_test.shape}")

    def __len__(self) -> int:
        return len(self.image_paths)

    def image(self, i: int) -> npt.NDArray[np.uint8]:
        """Frame `i` as (height, width, 3) RGB.

        Raises
        ------
        ImageError
            If the file cannot be decoded, or its size is not the camera's.
        """
        path = self.image_paths[i]
        image = read_image(path)
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise ImageError(
                f"{path}: image is {image.shape[1]}x{image.shape[0]} pixels, "
                f"the camera's are {self.camera.width}x{self.camera.height}"
            )
        return image if self.noise is None else self.noise.apply(image, path.name)

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
