"""A trained and calibrated pose model: everything that one image needs to become a region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins, SplitConformal
from conformodal.datasets import Split
from conformodal.motion import Described
from conformodal.poses import PinholeCamera, PoseFix
from conformodal.reasoning import Candidates, MotionPrior, SpreadScale, add_fixes, mode_candidates
from conformodal.vision import Backbone, Head, predict_proba

from .errors import OdometryError
from .landmarks import Landmarks
from .local import LocalFinder
from .radius import PoseRadius


@dataclass(frozen=True, eq=False)
class Search:
    """What reasoning starts from; nothing is promised of it.

    Attributes
    ----------
    proba
        Seven arrays (n, K_j).
    strangeness
        (n,) how little the model has seen that looks like each image, 1 where that is typical; None where nothing says.
    """

    proba: list[npt.NDArray[np.floating[Any]]]
    strangeness: npt.NDArray[np.float64] | None


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
        A finder without a network that has a say in that mean; or None.
    landmarks
        A map of corners, which the search starts from as well; or None.
    bins
        Bins of the seven targets.
    calibration
        Calibrated sets.
    sign_reference
        (4,) quaternion against which signs are fixed.
    prior, scale
        What reasoning needs to know of motion and of errors.
    camera
        Camera of the training images.
    split
        Which frames were used for what.
    data_digest
        Digest of the training data's frames, to recognise the data set again.
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
    bins: QuantileBins
    calibration: SplitConformal
    sign_reference: npt.NDArray[np.float64]
    prior: MotionPrior
    scale: SpreadScale
    camera: PinholeCamera
    split: Split
    data_digest: str
    configuration: dict[str, Any] = field(default_factory=dict)
    radius: PoseRadius | None = None

    @property
    def n_calibration(self) -> int:
        """Calibration frames behind the thresholds."""
        return int(self.calibration.scores_.shape[0])

    @property
    def unbounded(self) -> bool:
        """Whether a region is the whole space in some target, for want of calibration frames."""
        return bool(np.isposinf(self.calibration.thresholds_).any())

    def proba(self, features: npt.NDArray[np.float32]) -> list[npt.NDArray[np.floating[Any]]]:
        """Softmax of the seven targets for features (n, F)."""
        return predict_proba(self.head, features)

    def search(self, features: npt.NDArray[np.float32]) -> Search:
        """What reasoning starts from, for features (n, F): the mean of all finders' softmaxes. Not calibrated."""
        found = [predict_proba(finder, features) for finder in self.finders]
        mean = [np.mean(blocks, axis=0) for blocks in zip(*found, strict=True)]
        if self.local is None:
            return Search(mean, None)
        answers = self.local.regression.predict(features)
        return Search(self.local.blend(mean, answers, self.bins), self.local.strangeness(answers))

    def fixes(self, image: Described) -> list[PoseFix]:
        """Where an image could have been taken by its landmarks; at most one pose a place. Not calibrated."""
        return [] if self.landmarks is None else self.landmarks.fixes(image)

    def candidates(self, search: Search, fixes: Sequence[Sequence[PoseFix]] | None = None) -> list[Candidates]:
        """Candidate poses of every image, with spreads of the size of their errors; with its fixes, if they are given.

        Raises
        ------
        OdometryError
            If there are not as many lists of fixes as images.
        """
        found = mode_candidates(search.proba, self.bins, scale=self.scale, strangeness=search.strangeness)
        if fixes is None:
            return found
        if len(fixes) != len(found):
            raise OdometryError(f"{len(found)} images need as many lists of fixes, got {len(fixes)}")
        return [self.with_fixes(here, its) for here, its in zip(found, fixes, strict=True)]

    def with_fixes(self, candidates: Candidates, fixes: Sequence[PoseFix]) -> Candidates:
        """Candidates of one image, from wherever, weighed against its fixes."""
        volume = float(np.prod([max(e[-1] - e[0], 1e-3) for e in self.bins.edges_[:3]]))
        return add_fixes(candidates, fixes, volume)

    def recalibrate(self, alpha: float) -> None:
        """Promise another miscoverage rate, from the stored calibration scores.

        Raises
        ------
        ConformalError
            If `alpha` is outside (0, 1).
        """
        self.calibration = self.calibration.at(alpha)

    def check_camera(self, camera: PinholeCamera) -> None:
        """Refuse images of another camera: poses were learnt through this one.

        Raises
        ------
        OdometryError
            If size, intrinsics or distortion differ.
        """
        mine, other = self.camera, camera
        same = (mine.width, mine.height) == (other.width, other.height)
        values = [(mine.fx, other.fx), (mine.fy, other.fy), (mine.cx, other.cx), (mine.cy, other.cy)]
        same = same and np.array_equal(mine.distortion or np.zeros(4), other.distortion or np.zeros(4))
        if not same or any(abs(a - b) > 1e-3 * mine.width for a, b in values):
            raise OdometryError(f"the model was trained with {mine}, the source has {other}")
