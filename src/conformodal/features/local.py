"""Local features of an image by name, its global descriptor for retrieval, and how good it is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Self, TypeAlias
from zipfile import BadZipFile, ZipFile, ZipInfo

import cv2
import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import AnyArray, BoolArray, Float32Array, FloatArray, IntArray, UInt8Array
from conformodal.geometry import PinholeCamera
from conformodal.geometry.camera import NO_FLOW
from conformodal.io import thumbnail
from conformodal.io.decoding import grey_image

from .backbone import open_session
from .settings import VisionError

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

_ORB_BYTES, _ORB_CORNERS = 32, 500
_LEVELS = 4  # of ORB's pyramid; with more, corners come from coarse levels and poses get worse
_BLUR_PX = 1.2  # before detection: pixel noise of a sigma of 0.2 then leaves descriptors nearly unchanged
_MIN_WIDTH_PX = 320  # smaller images are enlarged: descriptors look at 31 pixels around a corner
XFEAT_STEP = 32  # the sides of images that its network sees are multiples of it
_XFEAT_CORNERS, _XFEAT_CHANNELS = 800, 64
_CELL = 8  # pixels across of XFeat's cells
HALFWAY_CELL, HALFWAY_CHANNELS = 4, 24  # of its maps halfway through the network
XFEAT_PARTS = "halfway", "features", "logits"  # of its network, in order
_MIN_HEAT = 0.05  # of a corner
_SUPPRESSED_PX = 5  # across; the hottest pixel of a window is its only corner
_TURNED_MARGIN_PX = 8  # corners of a turned image nearer to its former border are those of the border
_UNIT = 254.0  # length of directions as bytes: their components rarely exceed a half
# Matches of bits: ratio of the distances to the nearest and the second nearest (Lowe 2004); of directions: cosine
_RATIO, _MIN_COSINE = 0.85, 0.75
_BIT_COUNTS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.uint8)  # of each byte
# of matches where a pose says that they are: less than a quarter of the bits differ; cosine
_GUIDED_BITS, _GUIDED_COSINE = 0.5, 0.75

QUALITIES = ("brightness", "contrast", "detail")
NOT_MEASURED: FloatArray = np.full(len(QUALITIES), np.nan)
_MARGIN = 0.1  # of the range of each quality, at each end


# of corners, row by row: bits (uint8, packed), or directions of length 254 (int8)
Descriptors: TypeAlias = UInt8Array | npt.NDArray[np.int8]


class LocalFeatures(NamedTuple):
    """Corners of an image with their descriptors, and its global descriptor."""

    pixels: FloatArray  # (n, 2) undistorted corners
    descriptors: Descriptors  # (n, B)
    global_descriptor: Float32Array  # at unit length, to retrieve similar images
    quality: FloatArray = NOT_MEASURED  # (3,), see image_quality
    flow: FloatArray = NO_FLOW  # (2, 3), see conformodal.tracking.tracker.affine_flow

    @property
    def flows(self) -> FloatArray:
        """Flow (n, 2) of each corner, pixels per second."""
        return np.asarray(self.pixels @ self.flow[:, :2].T + self.flow[:, 2])

    def compensate_rolling_shutter(self, shutter: FloatArray, camera: PinholeCamera) -> LocalFeatures:
        """With corners where they are when the pose is taken, see :meth:`PinholeCamera.compensate_rolling_shutter`."""
        return self._replace(pixels=camera.compensate_rolling_shutter(self.pixels, self.flows, shutter))


class Corners(NamedTuple):
    """What a detector finds in an image."""

    pixels: FloatArray  # (n, 2)
    descriptors: Descriptors  # (n, B)
    global_descriptor: Float32Array | None = None  # at unit length, of a detector that describes the whole image


class Detector(ABC):
    """Corners and descriptors of images: a class of :data:`DETECTORS`, made from its network in ONNX, if it has one."""

    name: ClassVar[str]  # in saved models and on the command line
    describes_images: ClassVar[bool] = False  # whether it gives a global descriptor
    rotation_invariant: ClassVar[bool] = False  # whether descriptors stay the same where the camera rolls
    n_parts: ClassVar[int] = 1  # into which its work on an image is divided
    nothing: ClassVar[Corners]  # of an image without corners; its descriptors tell type and length of all

    def __init__(self, content: bytes = b"") -> None:
        self.content = content

    @abstractmethod
    def __call__(self, grey: UInt8Array) -> Corners:
        """Detect and describe the corners of a grey image (height, width), the strongest first."""

    def parts(self, grey: UInt8Array) -> Iterator[Corners | None]:
        """Do the same in :attr:`n_parts` steps of about the same time: None after each, and at last the corners."""
        yield self(grey)


class OrbDetector(Detector):
    """ORB (Rublee et al. 2011), in small images enlarged; it has no network."""

    name = "orb"
    rotation_invariant = True
    nothing = Corners(np.empty((0, 2)), np.empty((0, _ORB_BYTES), np.uint8))

    def __call__(self, grey: UInt8Array) -> Corners:
        """Detect and describe corners."""
        enlarged = -(-_MIN_WIDTH_PX // grey.shape[1])
        if enlarged > 1:
            grey = np.asarray(cv2.resize(grey, None, fx=enlarged, fy=enlarged), np.uint8)
        grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX), np.uint8)
        orb = cv2.ORB.create(_ORB_CORNERS, 1.2, _LEVELS, edgeThreshold=16, fastThreshold=5)
        corners, descriptors = orb.detectAndCompute(grey, None)
        if descriptors is None:
            return self.nothing
        # pixel centres are whole numbers, so that enlarging moves them by half a pixel
        pixels = (np.array([corner.pt for corner in corners]) + 0.5) / enlarged - 0.5
        strongest = np.argsort([-corner.response for corner in corners], kind="stable")
        return Corners(pixels[strongest], np.asarray(descriptors, np.uint8)[strongest])


class XFeatDetector(Detector):
    """XFeat (Potje et al. 2024), with corners located to parts of a pixel; its network is for one size of images."""

    name = "xfeat"
    describes_images = True
    n_parts = 3
    nothing = Corners(np.empty((0, 2)), np.empty((0, _XFEAT_CHANNELS), np.int8))

    def __init__(self, content: bytes) -> None:
        super().__init__(content)
        self._sessions = [open_session(part) for part in _unpack_networks(content)]
        nodes = [[*session.get_inputs(), *session.get_outputs()] for session in self._sessions]
        image = nodes[0][0]
        self._height, self._width = (int(side) for side in image.shape) if len(image.shape) == 2 else (0, 0)
        cells, halfway = ([self._height // size, self._width // size] for size in (_CELL, HALFWAY_CELL))
        sound = self._height % XFEAT_STEP == self._width % XFEAT_STEP == 0 < min(self._height, self._width)
        between, last = [HALFWAY_CHANNELS, *halfway], [_CELL**2 + 1, *cells]
        expected = [[image.shape, between], [between, [_XFEAT_CHANNELS, *cells], cells], [image.shape, last]]
        shapes = [[node.shape for node in part] for part in nodes]
        if not sound or image.type != "tensor(uint8)" or shapes != expected:
            raise VisionError(f"the network of local features must be XFeat's, got one of shapes {shapes}")

    def __reduce__(self) -> tuple[type[Self], tuple[bytes]]:
        return type(self), (self.content,)  # a session stays in its process

    def __call__(self, grey: UInt8Array) -> Corners:
        """Detect and describe corners."""
        *_, corners = self.parts(grey)
        assert corners is not None
        return corners

    def parts(self, grey: UInt8Array) -> Iterator[Corners | None]:
        """As of the class above; the last part ends with the corners."""
        resized = cv2.resize(grey, (self._width, self._height), interpolation=cv2.INTER_AREA)
        halfway, features, logits = (partial(_run, session) for session in self._sessions)
        image = np.asarray(resized, np.uint8)
        [middle] = halfway(image)
        yield None
        described, reliability = features(middle)
        yield None
        yield self._corners(described, reliability, logits(image)[0], grey.shape)

    def maps(self, image: UInt8Array) -> list[Float32Array]:
        """The network's features, reliability and logits of an image of its size, see ``scripts/networks.py``."""
        halfway, features, logits = (partial(_run, session) for session in self._sessions)
        return [*features(*halfway(image)), *logits(image)]

    def _corners(
        self, features: Float32Array, reliability: Float32Array, logits: Float32Array, shape: tuple[int, ...]
    ) -> Corners:
        """The corners of an image of a shape (height, width) from the network's maps of it."""
        width, height = self._width, self._height
        rows, columns = height // _CELL, width // _CELL
        odds = np.exp(logits - logits.max(axis=0))
        shares = (odds[:-1] / odds.sum(axis=0)).reshape(_CELL, _CELL, rows, columns)
        heat = np.ascontiguousarray(shares.transpose(2, 0, 3, 1)).reshape(height, width)
        hottest = cv2.dilate(heat, np.ones((_SUPPRESSED_PX, _SUPPRESSED_PX), np.uint8))
        index = np.flatnonzero((heat == hottest) & (heat > _MIN_HEAT))
        score = heat.ravel()[index] * cv2.resize(reliability, (width, height)).ravel()[index]
        index = index[np.argsort(-score, kind="stable")[:_XFEAT_CORNERS]]
        # twelve parts of the image: as many numbers as a thumbnail has, which loading a model checks
        down, across = (np.linspace(0, n, k, endpoint=False, dtype=np.int64) for n, k in ((rows, 3), (columns, 4)))
        parts = np.add.reduceat(np.add.reduceat(features, down, axis=1), across, axis=2).ravel()
        global_descriptor = parts / np.linalg.norm(parts)
        if index.size == 0:
            return self.nothing._replace(global_descriptor=global_descriptor)
        pixels = _located(heat, index)
        unit = features.reshape(_XFEAT_CHANNELS, -1).T
        unit = (unit / np.linalg.norm(unit, axis=1, keepdims=True)).reshape(rows, columns, -1)
        descriptors = _interpolated(unit, (pixels + 0.5) / _CELL - 0.5)
        descriptors *= _UNIT / np.linalg.norm(descriptors, axis=1, keepdims=True)
        pixels = (pixels + 0.5) * (shape[1] / width, shape[0] / height) - 0.5
        return Corners(pixels, np.clip(np.rint(descriptors), -127, 127).astype(np.int8), global_descriptor)


def pack_networks(parts: dict[str, bytes]) -> bytes:
    """Networks in ONNX by name as one archive, the same from the same networks."""
    archive = BytesIO()
    with ZipFile(archive, "w") as file:
        for name, content in parts.items():
            file.writestr(ZipInfo(f"{name}.onnx"), content)
    return archive.getvalue()


def _unpack_networks(content: bytes) -> list[bytes]:
    """The parts of XFeat's network."""
    try:
        with ZipFile(BytesIO(content)) as file:
            if sum(info.file_size for info in file.infolist()) > len(content):  # as no archive of ours
                raise VisionError("the network of local features is compressed")
            return [file.read(f"{part}.onnx") for part in XFEAT_PARTS]
    except (BadZipFile, KeyError, NotImplementedError, RuntimeError, EOFError, OSError) as exc:
        raise VisionError(f"the network of local features must be XFeat's in {len(XFEAT_PARTS)} parts: {exc}") from exc


def _run(session: InferenceSession, given: AnyArray) -> list[Float32Array]:
    """All outputs of a network with one input."""
    outputs: list[Float32Array] = session.run(None, {session.get_inputs()[0].name: given})
    return outputs


def _located(heat: Float32Array, index: IntArray) -> FloatArray:
    """Pixels (n, 2) where parabolas through the logarithm of the heat at local maxima and beside them are highest."""
    y, x = np.divmod(index, heat.shape[1])

    def offset(before: Float32Array, here: Float32Array, after: Float32Array) -> Float32Array:
        curvature = np.maximum(2 * here - before - after, 1e-3)
        return np.asarray(np.clip((after - before) / (2 * curvature), -0.5, 0.5))

    # mirrored at the border, so that a maximum there stays
    log = np.pad(np.log(heat + 1e-4), 1, mode="reflect")
    across = offset(log[y + 1, x], log[y + 1, x + 1], log[y + 1, x + 2])
    down = offset(log[y, x + 1], log[y + 1, x + 1], log[y + 2, x + 1])
    return np.column_stack((x + across, y + down)).astype(np.float64)


def _interpolated(grid: Float32Array, points: FloatArray) -> Float32Array:
    """Values (n, c) of a grid (rows, columns, c) between its points (x, y), bilinear."""
    points = np.clip(points, 0, (grid.shape[1] - 1, grid.shape[0] - 1))
    x, y = np.minimum(points.astype(np.int64), (grid.shape[1] - 2, grid.shape[0] - 2)).T
    right, lower = (points - np.column_stack((x, y))).astype(np.float32).T[..., None]
    upper_row = grid[y, x] * (1 - right) + grid[y, x + 1] * right
    lower_row = grid[y + 1, x] * (1 - right) + grid[y + 1, x + 1] * right
    return np.asarray(upper_row * (1 - lower) + lower_row * lower)


DETECTORS: dict[str, type[Detector]] = {"orb": OrbDetector, "xfeat": XFeatDetector}
ORB = OrbDetector()


def extract_local_features(
    image: UInt8Array, camera: PinholeCamera, detector: Detector = ORB, turn_rad: float = 0.0
) -> LocalFeatures:
    """Local features and global descriptor of an image (height, width[, 3]).

    The detector sees the image turned about its middle by `turn_rad`, from right to down. Corners are those of the
    image as given.
    """
    *_, features = local_feature_parts(grey_image(image), camera, detector, turn_rad)
    assert features is not None
    return features


def local_feature_parts(
    grey: UInt8Array, camera: PinholeCamera, detector: Detector, turn_rad: float = 0.0
) -> Iterator[LocalFeatures | None]:
    """The same of a grey image (height, width), in the detector's parts: None after each, at last the features."""
    parts = detector.parts(grey) if turn_rad == 0 else _turned_parts(detector, grey, turn_rad)
    for corners in parts:
        if corners is None:
            yield None
        else:
            pixels, descriptors, described = corners
            described = thumbnail(grey) if described is None else described
            yield LocalFeatures(camera.undistort(pixels), descriptors, described, image_quality(grey))


def _turned_parts(detector: Detector, grey: UInt8Array, turn_rad: float) -> Iterator[Corners | None]:
    """The corners of a turned image, where they are in the image as given; none at its former border."""
    height, width = grey.shape
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -np.degrees(turn_rad), 1.0)
    turned = cv2.warpAffine(grey, turn, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    for corners in detector.parts(np.asarray(turned, np.uint8)):
        if corners is None:
            yield None
        else:
            pixels = (corners.pixels - turn[:, 2]) @ turn[:, :2]
            low, high = _TURNED_MARGIN_PX, np.array((width, height)) - 1 - _TURNED_MARGIN_PX
            inside = np.flatnonzero(((pixels >= low) & (pixels <= high)).all(axis=1))
            yield Corners(pixels[inside], corners.descriptors[inside], corners.global_descriptor)


def match(descriptors: Descriptors, others: Sequence[Descriptors]) -> list[IntArray]:
    """Matches (m, 2) between the rows of descriptors and those of each of other sets, each row in one at most.

    Bits: the nearest, clearly nearer than the second. Directions: the nearest to each other, if they are alike enough.
    """
    numbers, directed, greatest = _numbers(descriptors), descriptors.dtype == np.int8, _greatest(descriptors)
    # set by set: products with all of them would be too large for the processor's cache
    return [_best_pairs(np.matmul(numbers, _numbers(each).T), directed, greatest) for each in others]


def _best_pairs(alike: Float32Array, directed: bool, greatest: float) -> IntArray:
    """Matches (m, 2) from similarities (n, k), which are overwritten."""
    if len(alike) == 0 or alike.shape[1] < 2:
        return np.empty((0, 2), np.int64)
    every, nearest = np.arange(len(alike)), alike.argmax(axis=1)
    first = alike[every, nearest]
    if directed:
        rows = np.flatnonzero((first >= _MIN_COSINE * greatest) & (first == alike.max(axis=0)[nearest]))
    else:
        alike[every, nearest] = -np.inf
        rows = np.flatnonzero(greatest - first < _RATIO * (greatest - alike.max(axis=1)))
    rows = rows[np.argsort(-first[rows], kind="stable")]
    _, best = np.unique(nearest[rows], return_index=True)
    rows = rows[best]
    return np.column_stack((rows, nearest[rows])).astype(np.int64)


def similar_enough(descriptors: Descriptors, others: Descriptors) -> tuple[Float32Array, BoolArray]:
    """Similarity (n,) of rows one by one, and whether it is enough where a pose says that they match."""
    if descriptors.dtype == np.int8:
        alike = np.einsum("ij,ij->i", _numbers(descriptors), _numbers(others)) / np.float32(_greatest(descriptors))
        return alike, alike > _GUIDED_COSINE
    differing = _BIT_COUNTS.take(descriptors.view(np.uint8) ^ others.view(np.uint8)).sum(axis=1, dtype=np.uint16)
    alike = 1 - 2 * differing / np.float32(_greatest(descriptors))
    return alike, alike > _GUIDED_BITS


class Matcher:
    """Matches between pairs of images, cached: the maps of several folds share images."""

    def __init__(self) -> None:
        # in the smallest integers that hold them: there are some dozens of pairs for each image of a recording
        self._cached: dict[tuple[int, int], tuple[LocalFeatures, LocalFeatures, AnyArray]] = {}

    def __getstate__(self) -> list[tuple[LocalFeatures, LocalFeatures, AnyArray]]:
        return list(self._cached.values())

    def __setstate__(self, state: list[tuple[LocalFeatures, LocalFeatures, AnyArray]]) -> None:
        self._cached = {(id(one), id(other)): (one, other, pairs) for one, other, pairs in state}

    def __call__(self, one: LocalFeatures, others: Sequence[LocalFeatures]) -> list[IntArray]:
        """Matches (m, 2) of the descriptors of an image and of each of other images, see :func:`match`."""
        missing = [other for other in others if (id(one), id(other)) not in self._cached]
        matches = match(one.descriptors, [other.descriptors for other in missing])
        for other, pairs in zip(missing, matches, strict=True):
            small = pairs.astype(np.min_scalar_type(int(pairs.max(initial=0))))
            self._cached[id(one), id(other)] = one, other, small  # ids are unique, since the cache holds both images
        return [self._cached[id(one), id(other)][2].astype(np.int64) for other in others]


def _numbers(descriptors: Descriptors) -> Float32Array:
    """Rows whose product is the similarity, exact in single precision: directions, and 1 or -1 for each bit."""
    if descriptors.dtype == np.int8:
        return descriptors.astype(np.float32)
    bits = np.unpackbits(descriptors.view(np.uint8), axis=1).astype(np.float32)
    bits *= 2
    bits -= 1
    return bits


def _greatest(descriptors: Descriptors) -> float:
    """The similarity of equal rows."""
    return _UNIT**2 if descriptors.dtype == np.int8 else 8.0 * descriptors.shape[1]


def image_quality(grey: UInt8Array) -> FloatArray:
    """(3,) :data:`QUALITIES` of a grey image (height, width), in grey levels.

    Mean and standard deviation; and the mean response to a mask that edges do not pass (Immerkaer 1996): much of it is
    noise, little of it is blur.
    """
    mean, spread = cv2.meanStdDev(grey)
    # the mask is that of second derivatives along both axes, which OpenCV takes five times faster than any other
    detail = cv2.norm(cv2.Sobel(grey, cv2.CV_16S, 2, 2, ksize=3), cv2.NORM_L1) / grey.size
    return np.array([mean[0, 0], spread[0, 0], detail], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class QualityRange:
    """The least and the largest of each quality, (3,), that known images have, or nearly."""

    low: FloatArray
    high: FloatArray

    @classmethod
    def of(cls, qualities: FloatArray) -> Self:
        """Of images with these qualities (n, 3), widened a little, so that images like them are rarely beyond."""
        low, high = qualities.min(axis=0), qualities.max(axis=0)
        return cls(low - _MARGIN * (high - low), high + _MARGIN * (high - low))

    def is_outside(self, qualities: FloatArray) -> BoolArray:
        """(n,) whether a quality (n, 3) is out of range; False where it was not measured."""
        return np.asarray(((qualities < self.low) | (qualities > self.high)).any(axis=1))
