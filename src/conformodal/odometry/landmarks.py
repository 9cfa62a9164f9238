"""The landmarks of a model: a map of the training frames, and how far its fixes can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from conformodal.conformal import SplitConformal
from conformodal.motion import Described, LandmarkMap, Matcher, build_map
from conformodal.poses import PinholeCamera, PoseFix, Trajectory, angle_between_quats

from .fix_scale import FixErrors, FixScale, fit_fix_scale

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Progress = Callable[[int, int], None]

MAX_KEYFRAMES = 1000
_N_LEFT_OUT = 200  # frames that tell how far fixes are off
_LEAST_FIXES = 20
# A fix further off than this share of the depth is wrong, and nobody's correction.
_CORRECTABLE = 0.05
_SAME_PLACE = 0.5  # of the depth


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
        """Where an image could have been taken, place by place; fixes that are surer than a place is wide."""
        fixes = (self.scale.apply(fix, fix.n_inliers) for fix in self.map.fixes(image))
        return [fix for fix in fixes if fix.sigma_m < _SAME_PLACE * self.map.depth_m]


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
    matcher: Matcher | None = None,
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
    matcher
        See :func:`~conformodal.motion.build_map`.

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

    plain = build_map(described, truth.poses_se3, camera, depth_m, done(0), matcher)
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
    return fit_fix_scale(FixErrors(*np.array(rows).T), _SAME_PLACE * landmarks.depth_m)
