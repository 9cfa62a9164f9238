"""The landmarks of a model: a map of the training frames, and how far its fixes can be trusted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from conformodal.motion import Described, LandmarkMap, Matcher, build_map
from conformodal.poses import PinholeCamera, PoseFix, Trajectory, angle_between_quats

from .fix_scale import FixErrors, FixScale, fit_fix_scale

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Progress = Callable[[int, int], None]

MAX_KEYFRAMES = 1000
N_LEFT_OUT = 200  # frames that tell how far fixes are off
_LEAST_FIXES = 20
# A fix further off than this share of the depth is wrong, and nobody's correction.
_CORRECTABLE = 0.05
_SAME_PLACE = 0.5  # of the depth
# Frames that see so much of what a frame sees are hidden from it: none of them is left, or hardly one.
_SURROUNDINGS = (0.0, 0.3)
_HIDDEN_WEIGHT = 0.05  # how often a place is not in the map, against places that are


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
        fixes = (self.scale.apply(fix, *_evidence(fix)) for fix in self.map.fixes(image))
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


def fit_landmarks(
    described: Sequence[Described],
    truth: Trajectory,
    groups: Sequence[IntArray],
    camera: PinholeCamera,
    depth_m: float,
    progress: Progress | None = None,
    matcher: Matcher | None = None,
    n_left_out: int = N_LEFT_OUT,
) -> Landmarks | None:
    """Map frames with known poses, and learn from themselves how far fixes are off.

    Parameters
    ----------
    described, truth
        n frames.
    groups
        Vectors (n,): frames of one group are hidden together when one of them is left out, see
        :func:`~conformodal.datasets.held_out_together`; single frames and stretches, say.
    camera
        As the data set has it.
    depth_m
        Median depth of what is in view; NaN where it is not known.
    progress
        Called with frames done and frames in all.
    matcher
        See :func:`~conformodal.motion.build_map`.
    n_left_out
        Frames that tell how far fixes are off.

    Returns
    -------
    Landmarks, or None where depths are not known or too few frames can be placed
    """
    n = len(described)
    if not np.isfinite(depth_m) or n < _LEAST_FIXES:
        return None
    chosen = np.unique(np.linspace(0, n - 1, min(n, MAX_KEYFRAMES)).round().astype(np.int64))
    described, truth = [described[i] for i in chosen], truth[chosen]
    groups = [group[chosen] for group in groups]
    n = len(chosen)
    left_out = np.unique(np.linspace(0, n - 1, min(n, n_left_out)).round().astype(np.int64))
    total = 2 * n + len(left_out)

    def done(before: int) -> Progress | None:
        return None if progress is None else lambda count, _: progress(before + count, total)

    plain = build_map(described, truth.poses_se3, camera, depth_m, done(0), matcher)
    corrected = plain.corrected(_corrections(plain, described, truth, done(n)))
    scale = _fit_scale(corrected, described, truth, groups, left_out, done(2 * n))
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
    groups: Sequence[IntArray],
    left_out: IntArray,
    progress: Progress | None,
) -> FixScale | None:
    """Fix frames while less and less around them is known: without their piece, their stretch, their surroundings."""
    rows = []
    for k, i in enumerate(left_out.tolist()):
        overlap = view_overlap(landmarks.poses_se3, i, landmarks.camera, landmarks.depth_m)
        hidings = [(group == group[i], 1.0) for group in groups]
        hidings += [(overlap > share, _HIDDEN_WEIGHT) for share in _SURROUNDINGS]
        for hidden, weight in hidings:
            for fix in landmarks.fixes(described[i], hidden):
                off = float(np.linalg.norm(fix.position_xyz - truth.positions_xyz[i]))
                turned = float(angle_between_quats(fix.orientation_quat_wxyz, truth.orientations_quat_wxyz[i]))
                claims = (off, fix.sigma_m, turned, fix.sigma_rad, fix.apart)
                rows.append((*claims, weight, *_evidence(fix)))
        if progress is not None:
            progress(k + 1, len(left_out))
    if len(rows) < _LEAST_FIXES:
        return None
    table = np.array(rows)
    off, claim, turned, turn_claim, apart, weights = table[:, :6].T
    errors = FixErrors(off, claim, turned, turn_claim, apart, table[:, 6:], weights)
    return fit_fix_scale(errors, _SAME_PLACE * landmarks.depth_m)


def _evidence(fix: PoseFix) -> tuple[float, float, float]:
    """What speaks for a fix: different corners, their share of those matched, and of the image."""
    return float(max(fix.n_inliers, 1)), max(fix.inlier_share, 1e-3), max(fix.image_share, 1e-3)


def view_overlap(poses_se3: FloatArray, i: int, camera: PinholeCamera, depth_m: float) -> FloatArray:
    """Shares (n,) of what frame `i` sees that other frames see too, from their poses (n, 4, 4) ``T_world_cam``.

    Points on a grid of pixels, at half, once and twice the depth, stand for what it sees; walls are not known.
    """
    # middles of cells: on the image's very edges rounding would decide, and no frame would see all that it sees
    across, down = ((np.arange(count) + 0.5) * side / count for side, count in ((camera.width, 5), (camera.height, 4)))
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays = np.column_stack((camera.on_plane(pixels), np.ones(len(pixels))))
    points = np.concatenate([rays * (depth_m * times) for times in (0.5, 1.0, 2.0)])
    world = points @ poses_se3[i, :3, :3].T + poses_se3[i, :3, 3]
    local = (world - poses_se3[:, None, :3, 3]) @ poses_se3[:, :3, :3]
    ahead = local[..., 2] > 1e-6
    plane = local[..., :2] / np.where(ahead, local[..., 2], 1.0)[..., None]
    seen = plane * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = ahead & (seen >= 0).all(axis=2) & (seen < (camera.width, camera.height)).all(axis=2)
    return np.asarray(inside.mean(axis=1))
