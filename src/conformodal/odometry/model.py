"""A trained and calibrated pose model: everything that one image needs to become a region."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins, Regions, SplitConformal
from conformodal.conformal.checks import Alpha
from conformodal.datasets import Split
from conformodal.motion import Described
from conformodal.poses import PinholeCamera, PoseFix
from conformodal.reasoning import (
    Candidates,
    MotionPrior,
    SpreadScale,
    add_fixes,
    mode_candidates,
    on_cells,
    pool_fixes,
)
from conformodal.vision import Backbone, Head, predict_proba

from .config import Method
from .errors import OdometryError
from .identity import FrameIdentities
from .known import KnownPlaces
from .landmarks import Fixes, Landmarks
from .local import LocalFinder
from .radius import PoseRadius
from .region_rules import RegionRules

_FRAMES_AT_A_TIME = 256  # pooled: seven times some sixteen hundred cells each


@dataclass(frozen=True, eq=False)
class Search:
    """What reasoning starts from; nothing is promised of it.

    Attributes
    ----------
    proba
        Seven arrays (n, K_j): the mean of the finders' softmaxes.
    strangeness
        (n,) how little the model has seen that looks like each image, 1 where that is typical; None where nothing says.
    fixes
        Of each image, by the training frames most like it; empty where there is no such finder.
    """

    proba: list[npt.NDArray[np.floating[Any]]]
    strangeness: npt.NDArray[np.float64] | None
    fixes: list[list[PoseFix]]


@dataclass(eq=False)
class PoseModel:
    """What training and calibration leave behind.

    Attributes
    ----------
    backbone, head
        Image to softmax of every target; calibrated, so never trained on the calibration frames.
    finders
        The same with other starts, trained on the calibration frames as well. Nothing is promised of them: the search
        for the pose starts from their mean.
    local
        A finder without a network, which the search starts from as well; or None.
    landmarks
        A map of corners, which the search starts from as well; or None.
    region_landmarks
        A map that the region rests on: it knows nothing of the frames that calibrate; or None.
    known
        Places that the region's sources know; None where nothing tells them.
    bins
        Bins of the seven targets.
    rules
        Calibrated thresholds, by kind of evidence.
    sign_reference
        (4,) quaternion against which signs are fixed.
    prior, scale
        What reasoning needs to know of motion and of errors.
    camera
        Camera of the training images.
    split
        Which frames were used for what.
    known_frames
        All frames of the training data, in the order that `split` numbers them in, to know them again.
    configuration
        Settings behind the model, for the record.
    radius
        Promise for the chosen pose, see :class:`~conformodal.odometry.PoseRadius`; None before it was calibrated.
    """

    backbone: Backbone
    head: Head
    finders: tuple[Head, ...]
    local: LocalFinder | None
    landmarks: Landmarks | None
    region_landmarks: Landmarks | None
    known: KnownPlaces | None
    bins: QuantileBins
    rules: RegionRules
    sign_reference: npt.NDArray[np.float64]
    prior: MotionPrior
    scale: SpreadScale
    camera: PinholeCamera
    split: Split
    known_frames: FrameIdentities
    configuration: dict[str, Any] = field(default_factory=dict)
    radius: PoseRadius | None = None

    @property
    def method(self) -> Method:
        """Which system it belongs to."""
        return Method(self.configuration.get("method", Method.CONFORMODAL))

    @property
    def calibration(self) -> SplitConformal:
        """Calibrated sets from the softmax alone, whatever the image."""
        return self.rules.softmax

    @property
    def n_calibration(self) -> int:
        """Calibration frames behind the thresholds."""
        return int(self.calibration.scores_.shape[0])

    def proba(self, features: npt.NDArray[np.float32]) -> list[npt.NDArray[np.floating[Any]]]:
        """Softmax of the seven targets for features (n, F)."""
        return predict_proba(self.head, features)

    def search(self, features: npt.NDArray[np.float32]) -> Search:
        """What reasoning starts from, for features (n, F). Not calibrated."""
        found = [predict_proba(finder, features) for finder in self.finders]
        mean = [np.mean(blocks, axis=0) for blocks in zip(*found, strict=True)]
        if self.local is None:
            return Search(mean, None, [[] for _ in features])
        answers = self.local.regression.predict(features)
        return Search(mean, self.local.strangeness(answers), self.local.fixes(answers))

    def fixes(self, image: Described) -> Fixes:
        """Where an image could have been taken by its landmarks; at most one pose a place and map."""
        search = [] if self.landmarks is None else self.landmarks.fixes(image)
        if self.region_landmarks is self.landmarks:
            return Fixes(search, search)
        return Fixes(search, [] if self.region_landmarks is None else self.region_landmarks.fixes(image))

    def known_p(self, features: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """(n,) p-values of "this image shows a place that is known", for features (n, F); NaN where nothing tells."""
        return np.full(len(features), np.nan) if self.known is None else self.known.p_values(features)

    def kinds(self, known_p: npt.NDArray[np.float64], fixes: Sequence[Fixes] | None = None) -> npt.NDArray[np.int64]:
        """(n,) what each region rests on, see :class:`~conformodal.odometry.Evidence`."""
        return self.rules.kinds(known_p, None if fixes is None else [its.region for its in fixes])

    def calibration_of(self, *, with_fixes: bool) -> SplitConformal:
        """What is calibrated on all frames, from softmax and landmarks or from the softmax alone."""
        return self.rules.pooled if with_fixes and self.rules.pooled is not None else self.rules.softmax

    def regions(
        self,
        proba: Sequence[npt.NDArray[np.floating[Any]]],
        fixes: Sequence[Fixes] | None = None,
        rule: SplitConformal | None = None,
        *,
        known_p: npt.NDArray[np.float64] | None = None,
    ) -> Regions:
        """Calibrated regions of n images. All of one model's have the same bins.

        Parameters
        ----------
        proba
            From :meth:`proba`.
        fixes
            From :meth:`fixes`, of the same images; None where landmarks were not looked for, which is calibrated by
            itself.
        rule
            Thresholds whatever the evidence, in the place of :attr:`rules`.
        known_p
            (n,) from :meth:`known_p`; None takes all images for known.

        Raises
        ------
        OdometryError
            If there are not as many fixes or p-values as images.
        """
        n, pooled = len(proba[0]), self.rules.pooled
        p_values = np.ones(n) if known_p is None else np.asarray(known_p)
        if len(p_values) != n:
            raise OdometryError(f"{n} images need as many p-values, got {len(p_values)}")
        if fixes is not None:
            _check_as_many(fixes, n)
        kinds = self.kinds(p_values, fixes)
        limits = self.rules.thresholds(kinds) if rule is None else np.tile(rule.thresholds_, (n, 1))
        if pooled is not None and fixes is not None:
            parts = self._pooled(proba, fixes, pooled)
            return Regions.concatenate([pooled.regions_at(part, limits[rows]) for rows, part in parts])
        alone = self.rules.softmax.regions_at(list(proba), limits)
        if pooled is None:
            return alone
        masks = [on_cells(np.asarray(mask), self.bins, j) for j, mask in enumerate(alone.masks)]
        return Regions(pooled.cells, masks, alone.unbounded)

    def scores(
        self,
        proba: Sequence[npt.NDArray[np.floating[Any]]],
        targets: npt.NDArray[np.float64],
        fixes: Sequence[Fixes] | None = None,
    ) -> npt.NDArray[np.floating[Any]]:
        """Nonconformity scores (n, 7) of `targets` (n, 7): a set holds those that are at most its threshold.

        Parameters
        ----------
        proba, fixes
            As for :meth:`regions`.
        targets
            See :func:`~conformodal.odometry.pose_targets`.

        Raises
        ------
        OdometryError
            If there are not as many fixes as images.
        """
        rule = self.rules.pooled
        if rule is None or fixes is None:
            return self.calibration.score_samples(list(proba), targets)
        parts = self._pooled(proba, fixes, rule)
        return np.concatenate([rule.score_samples(part, targets[rows]) for rows, part in parts])

    def _pooled(
        self, proba: Sequence[npt.NDArray[np.floating[Any]]], fixes: Sequence[Fixes], rule: SplitConformal
    ) -> Iterator[tuple[slice, list[npt.NDArray[np.float64]]]]:
        """Probabilities of cells, some frames at a time: there are many cells."""
        cells, n = rule.bins, len(proba[0])
        _check_as_many(fixes, n)
        for start in range(0, max(n, 1), _FRAMES_AT_A_TIME):
            rows = slice(start, start + _FRAMES_AT_A_TIME)
            here = [its.region for its in fixes[rows]]
            yield rows, pool_fixes([p[rows] for p in proba], here, self.bins, cells, self.sign_reference)

    def candidates(self, search: Search, fixes: Sequence[Fixes] | None = None) -> list[Candidates]:
        """Candidate poses of every image, with spreads of the size of their errors.

        Modes of the softmax, weighed against what similar frames say and, if they are given, against fixes by
        landmarks.

        Raises
        ------
        OdometryError
            If there are not as many fixes as images.
        """
        found = mode_candidates(search.proba, self.bins, scale=self.scale, strangeness=search.strangeness)
        found = [self.with_fixes(here, its) for here, its in zip(found, search.fixes, strict=True)]
        if fixes is None:
            return found
        _check_as_many(fixes, len(found))
        return [self.with_fixes(here, its.search) for here, its in zip(found, fixes, strict=True)]

    def with_fixes(self, candidates: Candidates, fixes: Sequence[PoseFix]) -> Candidates:
        """Candidates of one image, from wherever, weighed against its fixes."""
        volume = float(np.prod([max(e[-1] - e[0], 1e-3) for e in self.bins.edges_[:3]]))
        return add_fixes(candidates, fixes, volume)

    def recalibrate(self, alpha: Alpha) -> None:
        """Promise another miscoverage rate, from the stored calibration scores.

        Raises
        ------
        ConformalError
            If `alpha` is outside (0, 1).
        """
        self.rules = self.rules.at(alpha)

    def set_novelty_level(self, level: float) -> None:
        """Take images for unknown at another p-value: at most `level`; 0 takes none.

        Raises
        ------
        OdometryError
            If `level` is negative, or 1 or more.
        """
        if not 0 <= level < 1:
            raise OdometryError(f"novelty level must be at least 0 and below 1, got {level}")
        self.rules = replace(self.rules, level=0.0 if self.known is None else self.known.level(level))

    def check_camera(self, camera: PinholeCamera, tolerance: float = 1e-3) -> None:
        """Refuse images of another camera: poses were learnt through this one.

        Parameters
        ----------
        camera
            Of the images.
        tolerance
            How far intrinsics may differ, as a share of the image's width.

        Raises
        ------
        OdometryError
            If size, intrinsics or distortion differ.
        """
        mine, other = self.camera, camera
        same = (mine.width, mine.height) == (other.width, other.height)
        values = [(mine.fx, other.fx), (mine.fy, other.fy), (mine.cx, other.cx), (mine.cy, other.cy)]
        same = same and _lens(mine) == _lens(other)
        if not same or any(abs(a - b) > tolerance * mine.width for a, b in values):
            raise OdometryError(f"the model was trained with {mine}, the source has {other}")


def _lens(camera: PinholeCamera) -> tuple[float, ...]:
    """All five numbers, whether a file says those that are zero or not."""
    return (*camera.distortion, *[0.0] * (5 - len(camera.distortion)))


def _check_as_many(fixes: Sequence[Fixes], n_images: int) -> None:
    if len(fixes) != n_images:
        raise OdometryError(f"{n_images} images need as many fixes, got {len(fixes)}")
