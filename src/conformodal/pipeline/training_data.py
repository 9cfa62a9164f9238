"""What a model and every baseline learn from: a split recording, its folds, and the depth of its scene."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from conformodal.conformal import conformal_rank
from conformodal.conformal.checks import Alpha
from conformodal.core.arrays import Float32Array, FloatArray, IntArray, evenly_spread
from conformodal.core.parallel import in_threads
from conformodal.core.progress import StageProgress
from conformodal.core.ranges import as_member
from conformodal.features.backbone import Backbone
from conformodal.features.extract import FeatureCache
from conformodal.features.head import Projection
from conformodal.features.local import ORB, Detector, extract_local_features, match
from conformodal.geometry import matrix_from_quat_wxyz
from conformodal.geometry.adjustment import MAD_OF_NORMAL
from conformodal.geometry.triangulation import Rays, triangulate
from conformodal.io import Recording, Split, SplitKind, held_out_together
from conformodal.io.decoding import grey_image
from conformodal.localizer.sources.registry import SourceData
from conformodal.tracking.submaps import build_submaps
from conformodal.tracking.tracker import CornerTracker

from .config import Calibration, ModelConfig, OdometryError

# Number of folds. Each needs a map, which takes most of the training time. On redkitchen `blocks` (seed 20) three
# gave the coverage and lengths of five; in a corridor of identical rooms (benchmarks/unseen.py, seed 20, stretches)
# regions had 2.80 m with three, 0.21 m with four and 0.19 m with five: sources that lack a third of the frames
# take one room for another
_MAX_FOLDS = 4
_STRETCHES, _FRAMES = 10, 12  # that the depth is measured on, spread over all training frames, and frames of each
_GAP = 4.0  # a stretch ends at a gap longer than the median one by this factor
_MIN_SUBMAPS = 5  # with fewer, or fewer pairs, the depth is not known
# Pairs of frames whose corners are matched where none can be tracked, reliable points of a pair, and their tolerance
_PAIRS, _MIN_POINTS, _TOLERANCE_PX = 40, 20, 4.0
_MIN_SPREAD = 0.1  # standard deviation of the logarithm of the depth


@dataclass(frozen=True, eq=False)
class TrainingData:
    """A sequence with its split, the features (n, F) and the targets (n, 7) of all frames."""

    sequence: Recording
    split: Split
    backbone: Backbone
    features: Float32Array
    targets: FloatArray
    sign_reference: FloatArray
    cache: FeatureCache = field(default_factory=lambda: FeatureCache(None))
    detector: Detector = ORB  # of local features

    @cached_property
    def _shared(self) -> SourceData:
        shared = self.sequence, self.features, self.targets, self.sign_reference, self.split.kind
        return SourceData(*shared, detector=self.detector)

    @cached_property
    def depths(self) -> tuple[float, float]:
        """Median depth in metres and standard deviation of its logarithm, from the training part; or NaN."""
        return scene_depths(self.sequence, self.split.train, self.detector)

    def for_sources(self, config: ModelConfig, progress: StageProgress | None = None) -> SourceData:
        """The data as pose sources see them; local features and projections are cached for the next call."""
        return replace(
            self._shared,
            depth_m=self.depths[0],
            grid=self.backbone.config.grid,
            n_bins=config.n_bins,
            margin=config.margin,
            sigma_bins=config.sigma_bins,
            training=config.training,
            progress=progress,
        )

    def projection(self, rows: IntArray, components: int | None) -> Projection:
        """Principal components of some frames, see :meth:`SourceData.projection`."""
        return self._shared.projection(rows, components)


# ---- folds of the calibration: frames or stretches that are held out from the sources that estimate them


@dataclass(frozen=True, eq=False)
class Fold:
    """Frames that sources learn from, and held-out frames that these sources estimate."""

    train: IntArray
    held_out: IntArray


@dataclass(frozen=True, eq=False)
class Folds:
    """All folds, and the labels (n,) of all frames."""

    folds: list[Fold]  # one where frames calibrate
    region_frames: IntArray  # that the model's own sources learn from
    units: IntArray | None  # exchangeable units; None where every held-out frame is one
    pieces: IntArray  # frames of one piece are held out together in the novelty test
    whole_recordings: bool = False  # whether units are recordings

    @property
    def held_out(self) -> IntArray:
        """The frames that calibrate, fold by fold."""
        return np.concatenate([fold.held_out for fold in self.folds])


def make_folds(
    sequence: Recording, split: Split, calibration: Calibration | str = Calibration.AUTO, alpha: Alpha = 0.1
) -> Folds:
    """The folds of a sequence's training and calibration parts; those of stretches are drawn with the split's seed.

    Whole recordings take the place of stretches where there are enough of them for a finite threshold at `alpha`.
    """
    calibration = as_member(calibration, Calibration, "calibration", OdometryError)
    by_frame = calibration is Calibration.AUTO and split.kind is SplitKind.INTERLEAVED
    if by_frame or calibration is Calibration.FRAMES:
        pieces = held_out_together(sequence.recording, split.kind, given_test=sequence.given_test)
        return Folds([Fold(split.train, split.calibration)], split.train, None, pieces)
    used = np.sort(np.concatenate((split.train, split.calibration)))
    units = sequence.recording
    n_recordings = len(np.unique(units[used]))
    whole = conformal_rank(n_recordings, alpha) <= n_recordings
    if not whole:
        units = held_out_together(sequence.recording, SplitKind.BLOCKS)
    names, folds = np.random.default_rng(split.seed).permutation(np.unique(units[used])), []
    for part in np.array_split(names, min(_MAX_FOLDS, len(names))):
        hidden = np.isin(units[used], part)
        folds.append(Fold(used[~hidden], used[hidden]))
    return Folds(folds, used, units, units, whole_recordings=whole)


# ---- the depth of the scene, learnt from training frames; it gives submaps their scale


def scene_depths(sequence: Recording, frames: IntArray, detector: Detector = ORB) -> tuple[float, float]:
    """Median depth in metres of what the camera sees in `frames`, and spread of its logarithm; NaN if not known.

    Where frames are too far apart for corners to be tracked, local features are matched instead.
    """
    tracked = measure_depths(sequence, frames)
    return tracked if np.isfinite(tracked).all() else match_depths(sequence, frames, detector)


def measure_depths(sequence: Recording, frames: IntArray) -> tuple[float, float]:
    """Median depth of corners in metres, and spread of its logarithm, from `frames`; NaN from too few submaps."""
    truth = sequence.require_truth()
    depths = []
    for stretch in _stretches(frames, sequence.recording):
        places, quats = truth.positions_xyz[stretch], truth.orientations_quat_wxyz[stretch]
        tracker, corners = CornerTracker(), []
        for i in stretch.tolist():
            tracker.advance(grey_image(sequence.image(i)))
            tracker.mark()
            corners.append(tracker.corners())
        for submap in build_submaps(corners, sequence.camera):
            # scaled to the true positions; not positive if the two disagree
            path = submap.positions @ matrix_from_quat_wxyz(quats[submap.frames[:1]])[0].T
            way = places[submap.frames] - places[submap.frames[0]]
            depths.append(submap.depth * float(np.sum(path * way) / np.sum(path**2)))
    return _median_and_spread([depth for depth in depths if depth > 0])


def _median_and_spread(depths: list[float]) -> tuple[float, float]:
    """Of some depths, and of their logarithms; NaN of too few."""
    if len(depths) < _MIN_SUBMAPS:
        return float("nan"), float("nan")
    logs = np.log(depths)
    middle = float(np.median(logs))
    spread = float(np.median(np.abs(logs - middle))) / MAD_OF_NORMAL
    return float(np.exp(middle)), max(spread, _MIN_SPREAD)


def match_depths(sequence: Recording, frames: IntArray, detector: Detector) -> tuple[float, float]:
    """As :func:`measure_depths`, from corners that match between training frames that follow each other."""
    camera, poses = sequence.camera, sequence.require_truth().poses_se3
    following = np.flatnonzero(np.diff(sequence.recording[frames]) == 0)
    pairs = [frames[k : k + 2] for k in following[evenly_spread(len(following), _PAIRS)].tolist()]
    seen = np.unique(pairs).tolist()
    extracted = in_threads(lambda i: extract_local_features(sequence.image(i), camera, detector), seen)
    features, depths = dict(zip(seen, extracted, strict=True)), []
    for pair in pairs:
        here, there = (features[i] for i in pair.tolist())
        [matches] = match(here.descriptors, [there.descriptors])
        if not len(matches):
            continue
        planes = [camera.on_plane(one.pixels[matches[:, j]]) for j, one in enumerate((here, there))]
        corner, side = np.repeat(np.arange(len(matches)), 2), np.tile([0, 1], len(matches))
        R_world_cam, centres = poses[pair, :3, :3], poses[pair, :3, 3]
        rays = Rays(corner, corner, side, np.stack(planes, axis=1).reshape(-1, 2), R_world_cam, centres)
        points = triangulate(rays, _TOLERANCE_PX / camera.fx)
        along = (points.xyz[points.reliable] - centres[0]) @ R_world_cam[0, :, 2]
        if len(along) >= _MIN_POINTS:
            depths.append(float(np.median(along)))
    return _median_and_spread(depths)


def _stretches(frames: IntArray, recording: IntArray) -> list[IntArray]:
    """Stretches of neighbouring training frames, each of one recording and without large gaps."""
    gaps = np.diff(frames)
    if gaps.size == 0:
        return []
    apart = (gaps > _GAP * np.median(gaps)) | (np.diff(recording[frames]) != 0)
    pieces = []
    for part in np.split(frames, np.flatnonzero(apart) + 1):
        whole = [part[i : i + _FRAMES] for i in range(0, len(part) - _FRAMES + 1, _FRAMES)]
        pieces += whole or ([part] if len(part) > 2 else [])
    return [pieces[i] for i in evenly_spread(len(pieces), _STRETCHES)]
