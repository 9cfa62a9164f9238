"""Features of an image: the map of a frozen network, which keeps where in the image things are, and a thumbnail."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import Float32Array, UInt8Array
from conformodal.core.extras import require_extra
from conformodal.core.parallel import thread_limit
from conformodal.io import THUMBNAIL, thumbnail

from .settings import VisionError

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

INPUT, OUTPUT = "images", "map"  # of networks in ONNX
_PICTURE = THUMBNAIL[0] * THUMBNAIL[1]


class FeatureViews(NamedTuple):
    """Slices of the features: the network's map, the thumbnail, and both."""

    network: slice
    thumbnail: slice
    both: slice


def feature_views(n_features: int) -> FeatureViews:
    """The parts of a :class:`Backbone`'s features."""
    cut = n_features - _PICTURE
    return FeatureViews(slice(0, cut), slice(cut, n_features), slice(0, n_features))


def coarse_features(features: Float32Array, grid: tuple[int, int]) -> Float32Array:
    """The network's map, averaged over 2 x 2 cells: a global descriptor that is independent of the training images.

    Of features (n, F) whose map has `grid` rows and columns; in an odd grid, the last row or column stands for itself.
    """
    rows, columns = grid
    network = features[:, feature_views(features.shape[1]).network]
    maps = network.reshape(len(features), -1, rows, columns)
    maps = np.pad(maps, ((0, 0), (0, 0), (0, rows % 2), (0, columns % 2)), mode="edge")
    cells = maps.reshape(*maps.shape[:2], (rows + 1) // 2, 2, (columns + 1) // 2, 2)
    return np.asarray(cells.mean(axis=(3, 5)).reshape(len(features), -1), dtype=np.float32)


def at_unit_length(maps: Float32Array) -> Float32Array:
    """:func:`coarse_features` (n, G) at unit length: they retrieve the right place more often than thumbnails."""
    return np.asarray(maps / np.maximum(np.linalg.norm(maps, axis=1, keepdims=True), 1e-9), dtype=np.float32)


@dataclass(frozen=True)
class BackboneConfig:
    """Which features to take."""

    name: str = "efficientnet_lite0"  # its ImageNet weights come with a package
    # last block to run, None for all but the classifier; block 7 of Lite0 has 80 channels at 1/16 of the resolution,
    # later ones encode more of what is seen and less of where
    block: int | None = 7
    width: int = 320  # input size in pixels
    height: int = 240
    grid: tuple[int, int] = (6, 8)  # rows and columns the map is averaged into; (1, 1) loses positions


def open_session(content: bytes) -> InferenceSession:
    """A network in ONNX, ready to run; VisionError if it is none."""
    # the import alone writes an identifier of this computer, for events that go to Microsoft; 0 allows it
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    with require_extra("run", "running a model"):
        import onnxruntime  # noqa: PLC0415 - only where a network is run
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = thread_limit()
    # idle threads that spin take the cores from tracking and search
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as exc:  # ONNX Runtime raises classes of its own, without a common one
        raise VisionError(f"the network is not an ONNX file that ONNX Runtime reads: {exc}") from exc


class Backbone:
    """A feature extractor: a network in ONNX, which ONNX Runtime runs without torch.

    The file has the input ``images`` (n, height, width, 3) uint8 and the output ``map`` (n, channels * rows * columns)
    float32.
    """

    def __init__(self, config: BackboneConfig, content: bytes) -> None:
        self.config, self.content = config, content
        # of all that decides the features
        self.fingerprint = hashlib.sha256(content + repr(THUMBNAIL).encode()).hexdigest()
        self._session = open_session(content)
        shape = self._session.get_inputs()[0].shape[1:]
        names = [node.name for node in (*self._session.get_inputs(), *self._session.get_outputs())]
        size = self._session.get_outputs()[0].shape[-1]
        if names != [INPUT, OUTPUT] or shape != [config.height, config.width, 3]:
            raise VisionError(
                f"the network must have the input {INPUT!r} (n, {config.height}, {config.width}, 3) and the output "
                f"{OUTPUT!r}, got {names} and {shape}"
            )
        rows, columns = config.grid
        if not isinstance(size, int) or size % (rows * columns):
            raise VisionError(f"the network must give maps of grid {rows} x {columns}, got {size} features")
        self.n_features = size + _PICTURE
        self.n_coarse = size // (rows * columns) * ((rows + 1) // 2) * ((columns + 1) // 2)

    def maps(self, images: UInt8Array) -> Float32Array:
        """The network's features (n, channels * rows * columns) of images (n, h, w, 3) of the input size.

        Images go in one by one: a batch is no quicker, and rounds otherwise than a stream's single images.
        """
        maps = [self._session.run([OUTPUT], {INPUT: image[None]})[0] for image in np.ascontiguousarray(images)]
        return np.concatenate(maps)

    def describe(self, image: UInt8Array) -> npt.NDArray[np.float16]:
        """Features (F,) of an image (h, w, 3) of any size, rounded as the cache keeps them.

        The network's map, then a thumbnail of the image as its global descriptor: see :func:`feature_views`.
        """
        size = (self.config.width, self.config.height)
        if image.shape[1::-1] != size:  # averaged where it shrinks
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        picture = thumbnail(image) * np.sqrt(_PICTURE)
        return np.concatenate((self.maps(image[None])[0], picture)).astype(np.float16)

    def features_of(self, image: UInt8Array) -> Float32Array:
        """:meth:`describe` as (1, F), the same numbers as a data set's from the cache."""
        return self.describe(image)[None].astype(np.float32)
