"""Features of keyframes, which of them to match, and matches whose epipolar geometry is verified, by pycolmap."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from sklearn.cluster import MiniBatchKMeans

from conformodal.core.arrays import Float32Array, FloatArray
from conformodal.core.parallel import thread_limit
from conformodal.core.progress import StageProgress
from conformodal.geometry import PinholeCamera

from .clips import Clip
from .keyframes import SIDE_PX
from .settings import MapError, MapSettings, require_pycolmap

_BATCH_IMAGES, _BATCH_PAIRS = 20, 200  # between two reports of progress
_MAX_TRIALS = 2000  # of RANSAC: matches that pass the ratio test are mostly right
_WORDS, _WORD_SAMPLES = 64, 100_000
_FOCALS = np.geomspace(0.5, 3.0, 16)  # of the longer side: from a wide lens to a long one
_MIN_PAIRS = 5


class VerifiedPair(NamedTuple):
    """Matches of two keyframes that agree with one epipolar geometry."""

    first: str
    second: str
    pixels: FloatArray  # (m, 2, 2) in the first image and in the second, pixel centres whole
    near: bool  # whether the frames are neighbours in one video


@dataclass(frozen=True, eq=False)
class MatchedImages:
    """A database of features and matches."""

    database: Path
    images: Path  # folder that names of images start from
    pairs: frozenset[tuple[str, str]]  # that were matched
    near: frozenset[tuple[str, str]]  # of neighbours in one video
    known_cameras: frozenset[int]  # of the database: those that are calibrated


@contextmanager
def opened(database: Path) -> Iterator[Any]:
    """A pycolmap database, closed in the end."""
    handle = require_pycolmap().Database.open(database)
    try:
        yield handle
    finally:
        handle.close()


def match_keyframes(
    clips: Sequence[Clip], images: Path, database: Path, settings: MapSettings, report: StageProgress | None = None
) -> MatchedImages:
    """Find features in all keyframes, and match those of neighbours and of similar images."""
    known = _extract(clips, images, database, settings, report)
    near = _neighbours(clips, settings.neighbours)
    similar = _retrieved(clips, database, settings)
    pairs = sorted(near | similar)
    _match(pairs, database, settings, report)
    return MatchedImages(database, images, frozenset(pairs), frozenset(near), known)


def _extract(
    clips: Sequence[Clip], images: Path, database: Path, settings: MapSettings, report: StageProgress | None
) -> frozenset[int]:
    """SIFT features (Lowe 2004). Images of one size and calibration have one camera; returns those calibrated."""
    pycolmap = require_pycolmap()
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.max_image_size = thread_limit(), settings.feature_side_px
    options.sift.max_num_features, options.sift.first_octave = settings.max_features, 0
    groups: dict[tuple[tuple[int, int], PinholeCamera | None], list[str]] = defaultdict(list)
    for clip in clips:
        groups[clip.size, clip.camera] += clip.keyframe_images
    called = {
        image: f"{clip.source}: {name}"
        for clip in clips
        for image, name in zip(clip.images, clip.source_names, strict=True)
    }
    done, total, known = 0, sum(map(len, groups.values())), set[int]()
    for (_, camera), names in groups.items():
        reader = pycolmap.ImageReaderOptions()
        if camera is not None:
            reader.camera_model, reader.camera_params = _stated(camera)
        for start in range(0, len(names), _BATCH_IMAGES):
            batch = names[start : start + _BATCH_IMAGES]
            pycolmap.extract_features(
                database, images, batch, pycolmap.CameraMode.SINGLE, reader, options, pycolmap.Device.cpu
            )
            with opened(database) as handle:
                found = [handle.read_image_with_name(name) for name in batch]
            if None in found:
                name = called[batch[found.index(None)]]
                raise MapError(f"{name}: pycolmap cannot read the image. Save it as PNG")
            if start == 0:
                reader.existing_camera_id = found[0].camera_id
                known |= set() if camera is None else {int(reader.existing_camera_id)}
            done += len(batch)
            if report is not None:
                report("features", done, total)
    return frozenset(known)


def _stated(camera: PinholeCamera) -> tuple[str, str]:
    """A camera model of COLMAP and its parameters, whose first pixel has its centre at (0.5, 0.5)."""
    k1, k2, p1, p2, k3 = (*camera.distortion, *[0.0] * 5)[:5]
    numbers = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, k1, k2, p1, p2]
    model = "FULL_OPENCV" if k3 else "OPENCV"
    return model, ",".join(map(repr, map(float, numbers + ([k3, 0.0, 0.0, 0.0] if k3 else []))))


def _neighbours(clips: Sequence[Clip], steps: Sequence[int]) -> set[tuple[str, str]]:
    """Pairs of keyframes so many apart in one clip."""
    names = [clip.keyframe_images for clip in clips]
    return {(some[k], some[k + step]) for some in names for step in steps for k in range(len(some) - step)}


def _retrieved(clips: Sequence[Clip], database: Path, settings: MapSettings) -> set[tuple[str, str]]:
    """Pairs of each keyframe with the most similar ones that are not its neighbours."""
    names = [name for clip in clips for name in clip.keyframe_images]
    number = np.repeat(np.arange(len(clips)), [len(clip.keyframes) for clip in clips])
    place = np.concatenate([np.arange(len(clip.keyframes)) for clip in clips])
    descriptors = image_descriptors(database, names, settings.seed)
    similarity = descriptors @ descriptors.T
    apart = np.abs(place[:, None] - place) > max(settings.neighbours)
    similarity[~apart & (number[:, None] == number)] = -np.inf
    pairs = set[tuple[str, str]]()
    for i, row in enumerate(similarity):
        for j in np.argsort(-row)[: settings.retrieved].tolist():
            if np.isfinite(row[j]):
                pairs.add((names[min(i, j)], names[max(i, j)]))
    return pairs


def image_descriptors(database: Path, names: Sequence[str], seed: int) -> Float32Array:
    """One descriptor (n, d) of unit length per image: VLAD (Jegou et al. 2010) over its features."""
    with opened(database) as handle:
        features = [_root(handle.read_descriptors(handle.read_image_with_name(name).image_id)) for name in names]
    every = np.concatenate(features)
    if not len(every):
        return np.zeros((len(names), 1), dtype=np.float32)
    sample = np.random.default_rng(seed).permutation(len(every))[:_WORD_SAMPLES]
    n_words = min(_WORDS, len(every))
    words = MiniBatchKMeans(n_words, random_state=seed, n_init=1, batch_size=4096).fit(every[sample])
    vectors = np.zeros((len(names), n_words, every.shape[1]), dtype=np.float32)
    for vector, some in zip(vectors, features, strict=True):
        if len(some):
            word = words.predict(some)
            np.add.at(vector, word, some - words.cluster_centers_[word])
    vectors /= np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-9)  # of each word: bursts count once
    flat = vectors.reshape(len(names), -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9), dtype=np.float32)


def _root(descriptors: Any) -> Float32Array:
    """Descriptors (m, 128) of unit length."""
    data = np.asarray(getattr(descriptors, "data", descriptors), dtype=np.float32).reshape(-1, 128)
    return np.asarray(data / np.maximum(np.linalg.norm(data, axis=1, keepdims=True), 1e-9), dtype=np.float32)


def _match(
    pairs: Sequence[tuple[str, str]], database: Path, settings: MapSettings, report: StageProgress | None
) -> None:
    """Match pairs, and verify their epipolar geometry."""
    pycolmap = require_pycolmap()
    matching, verifying = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads = thread_limit()
    matching.sift.cpu_brute_force_matcher = True
    verifying.min_num_inliers = settings.min_matches
    verifying.ransac.random_seed, verifying.ransac.max_num_trials = settings.seed, _MAX_TRIALS
    listed = database.with_name("pairs.txt")
    for start in range(0, len(pairs), _BATCH_PAIRS):
        batch = pairs[start : start + _BATCH_PAIRS]
        listed.write_text("".join(f"{first} {second}\n" for first, second in batch), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed
        pycolmap.match_image_pairs(database, matching, pairing, verifying, pycolmap.Device.cpu)
        if report is not None:
            report("matching", start + len(batch), len(pairs))


def verified_pairs(matched: MatchedImages, min_matches: int) -> list[VerifiedPair]:
    """All pairs with so many verified matches."""
    pycolmap = require_pycolmap()
    found = list[VerifiedPair]()
    with opened(matched.database) as handle:
        names = {image.image_id: image.name for image in handle.read_all_images()}
        keypoints = {key: np.asarray(handle.read_keypoints(key), dtype=np.float64)[:, :2] - 0.5 for key in names}
        pair_ids, geometries = handle.read_two_view_geometries()
        for pair_id, geometry in zip(pair_ids, geometries, strict=True):
            matches = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
            if len(matches) < min_matches:
                continue
            one, other = pycolmap.pair_id_to_image_pair(pair_id)
            pixels = np.stack((keypoints[one][matches[:, 0]], keypoints[other][matches[:, 1]]), axis=1)
            near = bool({(names[one], names[other]), (names[other], names[one])} & matched.near)
            found.append(VerifiedPair(names[one], names[other], pixels, near))
    return found


def parallax_px(pairs: Sequence[VerifiedPair], sizes: dict[str, tuple[int, int]]) -> FloatArray:
    """What is left (n,) of the motion of matches, usually, if the camera only turned: pixels of images of 640.

    The focal length under which it is least is taken for all. A lens with distortion has some pixels of its own.
    """
    residuals = np.full((len(_FOCALS), len(pairs)), np.inf)
    for k, pair in enumerate(pairs):
        width, height = sizes[pair.first]
        side = max(width, height)
        centred = (pair.pixels - (np.array([width, height]) - 1) / 2) / side
        for row, focal in zip(residuals, _FOCALS.tolist(), strict=True):
            row[k] = SIDE_PX * focal * _off_rotation(centred / focal)
    return np.asarray(residuals[np.argmin(np.median(residuals, axis=1))]) if len(pairs) else np.zeros(0)


def _off_rotation(plane: FloatArray) -> float:
    """Median angle between bearings of matches (m, 2, 2), on the plane at depth 1, after the best rotation."""
    rays = np.concatenate((plane, np.ones((*plane.shape[:-1], 1))), axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    weights, left = np.ones(len(rays)), np.zeros(len(rays))
    for _ in range(3):  # robustly: near points move most
        turn, _ = Rotation.align_vectors(rays[:, 1], rays[:, 0], weights=weights)
        left = np.linalg.norm(turn.apply(rays[:, 0]) - rays[:, 1], axis=1)
        weights = 1 / np.maximum(left, np.median(left) + 1e-9)
    return float(np.median(left))
