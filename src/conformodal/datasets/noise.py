"""Noise of a camera's pixels, the same every time a frame is read."""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

import numpy as np
import numpy.typing as npt

from conformodal.core.ranges import check_ranges

from .errors import DatasetError


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

    def apply(self, image: npt.NDArray[np.uint8], name: str) -> npt.NDArray[np.uint8]:
        """The noisy image (h, w, 3), cut off at black and white and rounded, as a camera would."""
        if self.sigma == 0:
            return image
        rng = np.random.default_rng([self.seed, crc32(name.encode())])
        noisy = rng.standard_normal(image.shape, dtype=np.float32)
        noisy *= 255 * self.sigma
        noisy += image
        np.rint(noisy, out=noisy)
        return np.clip(noisy, 0, 255, out=noisy).astype(np.uint8)
