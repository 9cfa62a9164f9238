"""Features of image files, cached on disk by content."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from conformodal.core.arrays import AnyArray, Float32Array, UInt8Array
from conformodal.core.files import read_file, write_whole
from conformodal.core.parallel import in_threads
from conformodal.core.progress import Progress
from conformodal.io import ImageChange, ImageError, read_image

from .backbone import Backbone

_DIGEST = "digest"


class FeatureCache:
    """Arrays in files, named by the digest of what they were made from; without a folder nothing is cached.

    Each file holds one array and a digest of array and key, which detects damage and renamed files. The `kind` is the
    folder that it is in: ``features``, or ``networks``.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def key(self, backbone: Backbone, image_file: Path, noise: ImageChange | None = None) -> str:
        """Digest of everything that determines the features of an image file."""
        try:
            content = read_file(image_file)
        except OSError as exc:
            raise ImageError(f"{image_file}: image is missing or unreadable: {exc.strerror}") from exc
        disturbed = "" if noise is None else f"{noise} {image_file.name}"
        return hashlib.sha256(backbone.fingerprint.encode() + disturbed.encode() + content).hexdigest()

    def load(self, key: str, kind: str = "features") -> AnyArray | None:
        """The cached array, or None; a file that is damaged or another key's is removed."""
        if self.folder is None:
            return None
        path = self._path(self.folder, key, kind)
        try:
            content = read_file(path)
        except OSError:
            return None
        with suppress(SafetensorError, KeyError, TypeError, ValueError, AttributeError):
            arrays = load_tensors(content)
            if np.array_equal(arrays[_DIGEST], _digest(key, kind, arrays[kind])):
                return arrays[kind]
        with suppress(OSError):
            path.unlink()
        return None

    def store(self, key: str, array: AnyArray, kind: str = "features") -> None:
        """Cache an array, atomically."""
        if self.folder is not None:
            content = save_tensors({kind: array, _DIGEST: _digest(key, kind, array)})
            write_whole(self._path(self.folder, key, kind), content)

    @staticmethod
    def _path(folder: Path, key: str, kind: str) -> Path:
        return folder / kind / key[:2] / f"{key}.safetensors"


def _digest(key: str, kind: str, array: AnyArray) -> UInt8Array:
    digest = hashlib.blake2b(key.encode(), digest_size=16)
    digest.update(f"{kind} {array.dtype} {array.shape}".encode())
    digest.update(np.ascontiguousarray(array).tobytes())
    return np.frombuffer(digest.digest(), dtype=np.uint8)


def extract_features(
    image_files: Sequence[Path],
    backbone: Backbone,
    cache: FeatureCache,
    progress: Progress | None = None,
    noise: ImageChange | None = None,
) -> Float32Array:
    """Features of images, (n, F); with `noise`, of the disturbed images.

    Values are rounded to float16 whether cached or not, so that both give the same numbers.
    """

    def vector_of(file: Path) -> npt.NDArray[np.float16]:
        key = cache.key(backbone, file, noise)
        vector = cache.load(key)
        if vector is None:
            image = read_image(file)
            vector = backbone.describe(image if noise is None else noise.apply(image, file.name))
            cache.store(key, vector)
        return vector

    vectors = in_threads(vector_of, image_files, progress)
    return np.array(vectors, dtype=np.float32) if vectors else np.empty((0, 0), dtype=np.float32)
