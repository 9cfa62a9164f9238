"""Noise and other disturbances of images: bad light, motion, a noisy sensor, a thin connection."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from zlib import crc32

import cv2
import numpy as np
from PIL import Image

from conformodal.core.arrays import UInt8Array

from .errors import DatasetError
from .recording import ImageChange


@dataclass(frozen=True)
class PixelNoise:
    """Gaussian noise on every pixel and channel of the image as the camera delivers it (the paper, table 1).

    Every frame has another by its name.
    """

    sigma: float  # standard deviation where pixels are in [0, 1]
    seed: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sigma) and self.sigma >= 0):
            raise DatasetError(f"noise needs a standard deviation of at least 0, got {self.sigma}")

    def apply(self, image: UInt8Array, name: str) -> UInt8Array:
        """The noisy image (h, w, 3), cut off at black and white and rounded, as a camera would."""
        if self.sigma == 0:
            return image
        rng = np.random.default_rng([self.seed, crc32(name.encode())])
        noisy = rng.standard_normal(image.shape, dtype=np.float32)
        noisy *= 255 * self.sigma
        noisy += image
        np.rint(noisy, out=noisy)
        return np.clip(noisy, 0, 255, out=noisy).astype(np.uint8)


@dataclass(frozen=True)
class Disturbance:
    """One disturbance of each image, of random kind and strength: blur, exposure, pixel noise or JPEG compression.

    Every frame has its own by its name.
    """

    seed: int = 0
    noise: ImageChange | None = None  # of the images before they are disturbed
    # the weakest and the strongest disturbance of each kind; between them, logarithms are spread evenly
    blur_px: tuple[float, float] = (1.0, 6.0)  # standard deviation
    darker: tuple[float, float] = (0.6, 0.1)  # factor of brightness
    brighter: tuple[float, float] = (1.3, 2.5)
    sigma: tuple[float, float] = (0.03, 0.25)  # of pixel noise, where pixels are in [0, 1]
    jpeg_quality: tuple[float, float] = (30.0, 5.0)

    def apply(self, image: UInt8Array, name: str) -> UInt8Array:
        """The disturbed image (h, w, 3)."""
        if self.noise is not None:
            image = self.noise.apply(image, name)
        rng = np.random.default_rng([self.seed, crc32(name.encode())])
        kind, share = rng.choice(("blur", "darker", "brighter", "noise", "jpeg")), rng.random()

        def strength(ends: tuple[float, float]) -> float:
            return float(ends[0] ** (1 - share) * ends[1] ** share)

        match kind:
            case "blur":
                return np.asarray(cv2.GaussianBlur(image, (0, 0), strength(self.blur_px)), np.uint8)
            case "darker" | "brighter":
                factor = strength(self.darker if kind == "darker" else self.brighter)
                return np.asarray(np.clip(image * np.float32(factor), 0, 255), np.uint8)
            case "noise":
                return PixelNoise(strength(self.sigma), self.seed).apply(image, name)
        compressed = BytesIO()
        Image.fromarray(image).save(compressed, "jpeg", quality=round(strength(self.jpeg_quality)))
        return np.asarray(Image.open(compressed))
