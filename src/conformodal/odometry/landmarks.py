"""The landmarks of a model: a map of the training frames, and how far its fixes can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LogisticRegression

from conformodal.conformal import SplitConformal
from conformodal.motion import Described, LandmarkMap, build_map
from conformodal.poses import PinholeCamera, PoseFix, Trajectory, angle_between_quats
from conformodal.reasoning import fit_growth

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Progress = Callable[[int, int], None]

MAX_KEYFRAMES = 1000
_N_LEFT_OUT = 200  # frames that tell how far fixes are off
_LEAST_FIXES = 20
_MEDIAN_OF_NORM3 = 1.5382
# A fix further off than this share of the depth is wrong, and nobody's correction.
_CORRECTABLE = 0.05
_SAME_PLACE = 0.5  # of the depth
_WRONG = 5.0  # a fix off by more spreads than that is altogether wrong


@dataclass(frozen=True)
class FixScale:
    """How errors of fixes depend on their claims, learnt from frames whose own landmarks were hidden.

    Attributes
    ----------
    position, position_growth
        Spread in metres: the first, times the claim to the power of the second.
    rotation, rotation_growth
        The same in radians.
    trust_offset, trust_slope
        Log odds that a fix is right: the first, plus the second times the logarithm of its inliers.
    """

    position: float
    position_growth: float
    rotation: float
    rotation_growth: float
    trust_offset: float
    trust_slope: float

    def apply(self, fix: PoseFix) -> PoseFix:
        """The fix with spreads of the size of its errors."""
        odds = self.trust_offset + self.trust_slope * float(np.log(fix.n_inliers))
        return replace(
            fix,
            sigma_m=self.position * fix.sigma_m**self.position_growth,
            sigma_rad=self.rotation * fix.sigma_rad**self.rotation_growth,
            trust=float(1 / (1 + np.exp(-odds))),
        )


@dataclass(frozen=True, eq=False)
class Landmarks:
    """A map and the scale of its fixes."""

    map: LandmarkMap
    scale: FixScale

    @property
    def summary(self) -> dict[str, float]:
        """Numbers for the record."""
        return {
            "n_keyframes": len(self.map.poses_se3),
            "n_landmarks": len(self.map.points_xyz),
            "focal_px": round(self.map.camera.fx, 2),
        }

    def fixes(self, image: Described) -> list[PoseFix]:
        """Where an image could have been taken, place by place."""
        return [self.scale.apply(fix) for fix in self.map.fixes(image)]


@dataclass(frozen=True, eq=False)
class Fixes:
    """Where an image could have been taken, place by place, by two maps.

    Attributes
    ----------
    search
        By landmarks of all frames with known poses; nothing is promised of what follows from them.
    region
        By those of the training part alone: calibration frames are as new to them as any other, so regions may use
        them.
    """

    search: list[PoseFix] = field(default_factory=list)
    region: list[PoseFix] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class LandmarkRegions:
    """What regions need to know of landmarks.

    Attributes
    ----------
    landmarks
        Of the training part alone.
    calibration
        Calibrated sets from the softmax and these landmarks together, over finer cells than bins
        (:func:`~conformodal.reasoning.fix_cells`).
    """

    landmarks: Landmarks
    calibration: SplitConformal


def fit_landmarks(
    described: Sequence[Described],
    truth: Trajectory,
    pieces: IntArray,
    camera: PinholeCamera,
    depth_m: float,
    progress: Progress | None = None,
) -> Landmarks | None:
    """Map frames with known poses, and learn from themselves how far fixes are off.

    Parameters
    ----------
    described, truth
        n frames.
    pieces
        (n,) frames of one piece are hidden together when one of them is left out, see
        :func:`~conformodal.datasets.held_out_together`.
    camera
        As the data set has it.
    depth_m
        Median depth of what is in view; NaN where it is not known.
    progress
        Called with frames done and frames in all.

    Returns
    -------
    Landmarks, or None where depths are not known or too few frames can be placed
    """
    n = len(described)
    if not np.isfinite(depth_m) or n < _LEAST_FIXES:
        return None
    chosen = np.unique(np.linspace(0, n - 1, min(n, MAX_KEYFRAMES)).round().astype(np.int64))
    described, truth, pieces = [described[i] for i in chosen], truth[chosen], pieces[chosen]
    n = len(chosen)
    left_out = np.unique(np.linspace(0, n - 1, min(n, _N_LEFT_OUT)).round().astype(np.int64))
    total = 2 * n + len(left_out)

    def done(before: int) -> Progress | None:
        return None if progress is None else lambda count, _: progress(before + count, total)

    plain = build_map(described, truth.poses_se3, camera, depth_m, done(0))
    corrected = plain.corrected(_corrections(plain, described, truth, done(n)))
    scale = _fit_scale(corrected, described, truth, pieces, left_out, done(2 * n))
    return None if scale is None else Landmarks(corrected, scale)


def _corrections(
    plain: LandmarkMap, described: Sequence[Described], truth: Trajectory, progress: Progress | None
) -> FloatArray:
    found = np.full((len(described), 6), np.nan)
    for i, image in enumerate(described):
        hidden = np.zeros(len(described), dtype=bool)
        hidden[i] = True
        for fix in plain.fixes(image, hidden, most=1):
            off = fix.position_xyz - truth.positions_xyz[i]
            turned, true = (
                Rotation.from_quat(q, scalar_first=True)
                for q in (fix.orientation_quat_wxyz, truth.orientations_quat_wxyz[i])
            )
            if np.linalg.norm(off) < _CORRECTABLE * plain.depth_m:
                found[i] = np.concatenate((off, (turned * true.inv()).as_rotvec()))
        if progress is not None:
            progress(i + 1, len(described))
    return found


def _fit_scale(
    landmarks: LandmarkMap,
    described: Sequence[Described],
    truth: Trajectory,
    pieces: IntArray,
    left_out: IntArray,
    progress: Progress | None,
) -> FixScale | None:
    rows = []
    for k, i in enumerate(left_out.tolist()):
        for fix in landmarks.fixes(described[i], pieces == pieces[i]):
            off = float(np.linalg.norm(fix.position_xyz - truth.positions_xyz[i]))
            turned = float(angle_between_quats(fix.orientation_quat_wxyz, truth.orientations_quat_wxyz[i]))
            rows.append((off, fix.sigma_m, turned, fix.sigma_rad, fix.n_inliers))
        if progress is not None:
            progress(k + 1, len(left_out))
    if len(rows) < _LEAST_FIXES:
        return None
    off, claim, turned, turn_claim, inliers = np.array(rows).T
    here = off < _SAME_PLACE * landmarks.depth_m  # elsewhere the error is the distance between two places
    if here.sum() < _LEAST_FIXES:
        return None
    position, growth = _scale(off[here], claim[here])
    rotation, turn_growth = _scale(turned[here], turn_claim[here])
    right = here & (off < _WRONG * _MEDIAN_OF_NORM3 * position * claim**growth)
    offset, slope = _trust(np.log(inliers), right)
    return FixScale(position, growth, rotation, turn_growth, offset, slope)


def _scale(errors: FloatArray, claims: FloatArray) -> tuple[float, float]:
    growth = fit_growth(errors, claims)
    return max(float(np.median(errors / claims**growth)) / _MEDIAN_OF_NORM3, 1e-6), growth


def _trust(log_inliers: FloatArray, right: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Offset and slope of the log odds of being right; one more of each kind, so that neither is certain."""
    middle = float(np.median(log_inliers))
    x = np.concatenate((log_inliers, [middle, middle]))[:, None]
    found = LogisticRegression().fit(x, np.concatenate((right, [True, False])))
    return float(found.intercept_[0]), float(found.coef_[0, 0])
