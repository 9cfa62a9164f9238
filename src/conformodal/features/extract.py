"""Features of image files, cached on disk by content."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import Float32Array, UInt8Array
from conformodal.core.progress import Progress
from conformodal.io import ImageChange, ImageError, read_image

from .backbone import Backbone
from .cache import cache_arrays, cached_arrays

_BATCH = 16


class FeatureCache:
    """Feature vectors in files named by the digest of backbone and image; without a folder nothing is cached."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = None if folder is None else folder / "features"

    def key(self, backbone: Backbone, image_file: Path, noise: ImageChange | None = None) -> str:
        """Digest of everything that determines the features of an image file."""
        try:
            content = image_file.read_bytes()
        except OSError as exc:
            raise ImageError(f"{image_file}: image is missing or unreadable: {exc.strerror}") from exc
        disturbed = "" if noise is None or not noise.changes else f"{noise} {image_file.name}"
        return hashlib.sha256(backbone.fingerprint.encode() + disturbed.encode() + content).hexdigest()

    def load(self, key: str) -> npt.NDArray[np.float16] | None:
        """The cached vector, or None if it is missing or damaged."""
        if self.folder is None:
            return None
        found = cached_arrays(self._path(key), key)
        return None if found is None else found.get("features")

    def store(self, key: str, vector: npt.NDArray[np.float16]) -> None:
        """Cache a vector, atomically."""
        if self.folder is not None:
            cache_arrays(self._path(key), key, {"features": vector})

    def _path(self, key: str) -> Path:
        assert self.folder is not None
        return self.folder / key[:2] / f"{key}.safetensors"


def extract_features(
    image_files: Sequence[Path],
    backbone: Backbone,
    cache: FeatureCache,
    progress: Progress | None = None,
    noise: ImageChange | None = None,
) -> Float32Array:
    """Features of images, (n, F), cached ones first; with `noise`, of the disturbed images.

    Values are rounded to float16 whether cached or not, so that both give the same numbers.
    """
    out: Float32Array | None = None
    done = 0
    with ThreadPoolExecutor(max_workers=2) as pool:  # decode ahead while the network is busy
        batches = [range(a, min(a + _BATCH, len(image_files))) for a in range(0, len(image_files), _BATCH)]
        ahead = [pool.submit(_load_batch, image_files, b, backbone, cache, noise) for b in batches[:3]]
        for number, batch in enumerate(batches):
            keys, vectors, images = ahead.pop(0).result()
            if number + 3 < len(batches):
                ahead.append(pool.submit(_load_batch, image_files, batches[number + 3], backbone, cache, noise))
            if images:
                fresh = backbone.describe(np.stack(list(images.values())))
                for i, vector in zip(images, fresh, strict=True):
                    vectors[i] = vector
                    cache.store(keys[i], vector)
            for i in batch:
                if out is None:
                    out = np.empty((len(image_files), vectors[i].size), dtype=np.float32)
                out[i] = vectors[i]
            done += len(batch)
            if progress is not None:
                progress(done, len(image_files))
    return out if out is not None else np.empty((0, 0), dtype=np.float32)


def _load_batch(
    files: Sequence[Path], batch: range, backbone: Backbone, cache: FeatureCache, noise: ImageChange | None
) -> tuple[dict[int, str], dict[int, npt.NDArray[np.float16]], dict[int, UInt8Array]]:
    keys: dict[int, str] = {}
    vectors: dict[int, npt.NDArray[np.float16]] = {}
    images: dict[int, UInt8Array] = {}
    for i in batch:
        keys[i] = cache.key(backbone, files[i], noise)
        cached = cache.load(keys[i])
        if cached is None:
            image = read_image(files[i])
            images[i] = backbone.prepare(image if noise is None else noise.apply(image, files[i].name))
        else:
            vectors[i] = cached
    return keys, vectors, images
