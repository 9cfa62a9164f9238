"""The camera and the poses of a map's keyframes, fitted to the matches between its images.

The poses of a data set are often those of another sensor (7-Scenes gives the depth camera's), and its focal length is
nominal; both distort a map. Matches between frames must lie on epipolar lines, which determines nine unknowns of the
camera: focal length, mount and shutter. Rows that are read one after the other bend the picture of a moving camera, and
clocks differ.

Given poses have clock offsets, warps and noise of their own, too. Priors hold the adjusted poses near the given ones,
moved by the camera's mount; the standard deviations are learnt from the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray

from .adjustment import MAD_OF_NORMAL, POSITIONS, Adjustment, Bundle, ObservedCorners, PosePriors
from .camera import PinholeCamera
from .poses import rigid_motions
from .triangulation import Points, Rays

_NO_DELAY = np.zeros(2)
_MAX_MATCHES, _MIN_MATCHES = 10000, 400  # matches: half are fitted, half check the fit
_SCALE_PX = 1.5  # of the Cauchy loss
# prior standard deviations: of the logarithm of the focal length, of the mount's angles and of its position in scene
# depths, and of the shutter's delays
_SIGMA_LOG_FOCAL, _SIGMA_MOUNT_RAD, _SIGMA_MOUNT_DEPTHS, _SIGMA_S = 0.2, 0.05, 0.05, 0.02
_MAX_SIGMAS = 3.0  # further off, the poses do not belong to the images
# Chi-squared of the mount's position, three degrees of freedom: chance exceeds it once in a thousand times. Where the
# camera hardly turns, images do not determine it: one made of noise differs between maps of one recording, and moves
# the answers to turned images
_SIGNIFICANT, _MOUNT_POSITION = 16.27, slice(4, 7)  # of the unknowns

MIN_PER_FRAME = 20.0  # observations, on average: with fewer, poses stay as given
# standard deviations of the given poses at first, and the share to which a round may lower them
SIGMA_RAD, SIGMA_DEPTHS, _MIN_SIGMA = float(np.radians(1.0)), 0.01, 0.05
_SIGMA_ADJUSTED_FOCAL = 0.02  # of the logarithm of the focal length
_ITERATIONS, _ENOUGH = 8, 3e-3  # of one adjustment, and the share of the cost below which an iteration ends it
_SIGMA_KNOWN = 1e-6  # of poses that stay as they are
_TRACKS, _MIN_VIEWS = 80, 3  # of each frame, the longest first


class Matches(NamedTuple):
    """Corners seen by two frames."""

    frames: IntArray  # (m, 2)
    pixels: FloatArray  # (m, 2, 2) undistorted, in the one and in the other
    flows: FloatArray  # (m, 2, 2) of the same, pixels per second


class RigCalibration(NamedTuple):
    """A camera without distortion, and ``T_pose_cam`` (4, 4) from its frame to the one whose poses are given."""

    camera: PinholeCamera
    T_pose_cam: FloatArray
    shutter: FloatArray = _NO_DELAY  # (2,), see PinholeCamera.compensate_rolling_shutter


def fit_camera(matches: Matches, poses_se3: FloatArray, camera: PinholeCamera, depth_m: float) -> RigCalibration:
    """The camera with the smallest epipolar errors of matches, by robust least squares.

    It is fitted to half of the matches. Where it does not reduce the errors of the other half, or is far from the given
    one, the given one is returned. Delays that are out of range are left out, and so is a position of the mount that is
    not significant; the rest is judged without them.
    """
    given = RigCalibration(replace(camera, distortion=()), np.eye(4))
    if len(matches.frames) < _MIN_MATCHES:
        return given
    order = np.random.default_rng(0).permutation(len(matches.frames))[:_MAX_MATCHES]
    fitted, checked = (
        Matches(matches.frames[half], matches.pixels[half], matches.flows[half]) for half in np.array_split(order, 2)
    )
    mount_m = _SIGMA_MOUNT_DEPTHS * depth_m
    sigmas = _SIGMA_LOG_FOCAL, _SIGMA_MOUNT_RAD, mount_m, _SIGMA_S
    spreads = np.repeat(sigmas, (1, 3, 3, 2))

    def residuals(unknowns: FloatArray) -> FloatArray:
        errors = _epipolar_errors_px(_rig_of(given, unknowns * spreads), fitted, poses_se3)
        return np.concatenate((errors / _SCALE_PX, unknowns))

    def fit(columns: FloatArray) -> Any:
        """The unknowns in these columns (k, 9); the others are zero."""

        def of_columns(values: FloatArray) -> FloatArray:
            return residuals(values @ columns)

        return least_squares(of_columns, np.zeros(len(columns)), loss="cauchy", max_nfev=30)

    solution = fit(np.eye(9))
    unknowns = solution.x
    if _chi_squared_of_mount(solution) < _SIGNIFICANT:
        columns = np.delete(np.eye(9), _MOUNT_POSITION, axis=0)
        unknowns = fit(columns).x @ columns
    if np.abs(unknowns[7:]).max() >= _MAX_SIGMAS:
        unknowns[7:] = 0
    better = _rig_of(given, unknowns * spreads)
    before, after = (float(np.median(np.abs(_epipolar_errors_px(m, checked, poses_se3)))) for m in (given, better))
    return better if after < before and np.abs(unknowns).max() < _MAX_SIGMAS else given


def _chi_squared_of_mount(solution: Any) -> float:
    """Of the mount's position in a fit of all nine unknowns, whose errors scatter as they do."""
    errors, jacobian = solution.fun[:-9], np.asarray(solution.jac)[:-9]  # the last nine are the priors'
    noise = np.median(np.abs(errors)) / MAD_OF_NORMAL
    information = jacobian.T @ jacobian
    inverse = np.linalg.inv(information + np.eye(9))
    covariance = noise**2 * (inverse @ information @ inverse)[_MOUNT_POSITION, _MOUNT_POSITION]
    position = solution.x[_MOUNT_POSITION]
    return float(position @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ position)


def _rig_of(given: RigCalibration, unknowns: FloatArray) -> RigCalibration:
    factor = float(np.exp(unknowns[0]))
    T_pose_cam = rigid_motions(Rotation.from_rotvec(unknowns[1:4]).as_matrix(), unknowns[4:7])
    camera = given.camera
    return RigCalibration(replace(camera, fx=camera.fx * factor, fy=camera.fy * factor), T_pose_cam, unknowns[7:])


def _epipolar_errors_px(rig: RigCalibration, matches: Matches, poses_se3: FloatArray) -> FloatArray:
    """Signed first-order distances (m,) from the epipolar constraint, in pixels (Sampson)."""
    camera = rig.camera
    poses = poses_se3 @ rig.T_pose_cam
    (Ri, ci), (Rj, cj) = ((poses[:, :3, :3].take(f, axis=0), poses[:, :3, 3].take(f, axis=0)) for f in matches.frames.T)
    plane = camera.on_plane(camera.compensate_rolling_shutter(matches.pixels, matches.flows, rig.shutter))
    rays = np.concatenate((plane, np.ones((*plane.shape[:2], 1))), axis=2)
    baseline = np.einsum("mba,mb->ma", Rj, ci - cj)
    # in two steps: the product of three at once takes several times as long
    line_j = np.cross(baseline, np.einsum("mba,mb->ma", Rj, np.einsum("mbc,mc->mb", Ri, rays[:, 0])))
    line_i = np.einsum("mba,mb->ma", Ri, np.einsum("mbc,mc->mb", Rj, np.cross(rays[:, 1], baseline)))
    squares = line_j[:, 0] ** 2 + line_j[:, 1] ** 2 + line_i[:, 0] ** 2 + line_i[:, 1] ** 2
    distance = (line_j * rays[:, 1]).sum(axis=1) / np.sqrt(np.maximum(squares, 1e-18))
    return np.asarray(distance * (camera.fx + camera.fy) / 2)


class InlierRays(NamedTuple):
    """Rays that agree with the point of a corner that enough frames see, corner by corner."""

    corner: IntArray  # (m,) whose point it is, and
    number: IntArray  # (m,) the one that the ray goes through, among those of all frames
    frame: IntArray  # (m,)
    plane: FloatArray  # (m, 2) on the plane at depth 1
    points: FloatArray  # (m, 3)


class Tracks(NamedTuple):
    """Points, each seen by several frames at disjoint corners."""

    points: FloatArray  # (p, 3)
    point: IntArray  # (m,) 0 to p - 1, increasing: the point of each observation
    frame: IntArray  # (m,)
    plane: FloatArray  # (m, 2) on the plane at depth 1


@dataclass(frozen=True, eq=False)
class MapPoses:
    """A camera, its poses ``T_world_cam`` (n, 4, 4), and the learnt sigmas (6,) of the given ones.

    Sigmas are radians in the camera's frame, and metres.
    """

    rig: RigCalibration
    poses_cam: FloatArray
    sigmas: FloatArray

    def adjusted(self, poses_se3: FloatArray, tracks: Tracks) -> MapPoses:
        """Poses and camera after bundle adjustment, and mount and sigmas learnt from how far poses moved."""
        camera = self.rig.camera
        priors = PosePriors(poses_se3 @ self.rig.T_pose_cam, self.sigmas)
        bundle = self._bundle(tracks, priors, _SIGMA_ADJUSTED_FOCAL)
        poses_cam = rigid_motions(bundle.R_world_cam, bundle.centres)
        factor, relative = float(np.exp(bundle.log_focal)), np.linalg.inv(poses_se3) @ poses_cam
        mean = Rotation.from_matrix(relative[:, :3, :3]).mean().as_matrix()
        rig = self.rig._replace(
            camera=replace(camera, fx=camera.fx * factor, fy=camera.fy * factor),
            T_pose_cam=rigid_motions(mean, np.median(relative[:, :3, 3], axis=0)),
        )
        off = np.abs(priors._replace(poses=poses_se3 @ rig.T_pose_cam).deviations(bundle))
        spread = np.repeat([np.median(off[:, :3]), np.median(off[:, 3:])], 3) / MAD_OF_NORMAL
        sigmas = np.maximum(spread, _MIN_SIGMA * self.sigmas)
        return replace(self, rig=rig, poses_cam=poses_cam, sigmas=sigmas)

    def adjusted_beside(self, n_known: int, expected: FloatArray, tracks: Tracks) -> MapPoses:
        """Poses after bundle adjustment of those after the first `n_known`, which stay as they are, like the camera.

        `expected` (m, 4, 4) are the given ``T_world_cam`` of the others, near which the sigmas hold them.
        """
        known = self.poses_cam[:n_known]
        priors = PosePriors(
            np.concatenate((known, expected)),
            np.concatenate((np.full((n_known, 6), _SIGMA_KNOWN), np.tile(self.sigmas, (len(expected), 1)))),
        )
        bundle = self._bundle(tracks, priors)
        adjusted = rigid_motions(bundle.R_world_cam, bundle.centres)[n_known:]
        return replace(self, poses_cam=np.concatenate((known, adjusted)))

    def _bundle(self, tracks: Tracks, priors: PosePriors, focal_sigma: float = Adjustment.focal_sigma) -> Bundle:
        """Poses and points after bundle adjustment, and the focal length where its sigma is given."""
        camera, order = self.rig.camera, np.argsort(tracks.frame, kind="stable")
        adjustment = Adjustment(
            ObservedCorners(tracks.frame[order], tracks.point[order], tracks.plane[order]),
            sigma=2 / (camera.fx + camera.fy),
            cauchy=1.0,
            unknown=POSITIONS,
            iterations=_ITERATIONS,
            enough=_ENOUGH,
            priors=priors,
            focal_sigma=focal_sigma,
        )
        points = np.column_stack((tracks.points, np.ones(len(tracks.points))))
        return adjustment.solve(Bundle(self.poses_cam[:, :3, :3], self.poses_cam[:, :3, 3], points)).bundle

    def corrections(self, poses_se3: FloatArray) -> FloatArray:
        """Differences (n, 6) from the given poses, in the given frame: metres and a rotation vector, world."""
        poses = self.poses_cam @ np.linalg.inv(self.rig.T_pose_cam)
        turns = Rotation.from_matrix(poses[:, :3, :3] @ np.swapaxes(poses_se3[:, :3, :3], 1, 2)).as_rotvec()
        return np.concatenate((poses[:, :3, 3] - poses_se3[:, :3, 3], turns), axis=1)


def inlier_rays(rays: Rays, points: Points, tolerance: float) -> InlierRays:
    """The rays within a tolerance (at depth 1) of their corners' points, where three or more frames agree on these."""
    R = rays.R_world_cam.take(rays.camera, axis=0)
    off = np.nan_to_num(points.xyz).take(rays.corner, axis=0) - rays.centres.take(rays.camera, axis=0)
    local = np.einsum("mba,mb->ma", R, off)
    ahead = local[:, 2] > 0
    plane = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
    near = np.linalg.norm(plane - rays.plane, axis=1) < tolerance
    kept = points.reliable[rays.corner] & ahead & near
    kept &= (np.bincount(rays.corner[kept], minlength=len(points.xyz)) >= _MIN_VIEWS)[rays.corner]
    corner, first = rays.corner[kept], rays.number[rays.first]
    return InlierRays(first[corner], rays.number[kept], rays.camera[kept], rays.plane[kept], points.xyz[corner])


def choose_tracks(chunks: Sequence[InlierRays], n_frames: int) -> Tracks:
    """Long tracks, so many that each frame has enough.

    A corner is in one track at most, so no observation counts twice.
    """
    corner, number, frame, plane, points = map(np.concatenate, zip(*chunks, strict=True))
    starts = np.flatnonzero(np.diff(corner, prepend=-1))
    counts = np.diff(np.append(starts, len(corner)))
    order = np.argsort(-counts, kind="stable")
    used = bytearray(int(max(number.max(initial=0), corner.max(initial=0))) + 1)
    tracks_per_frame, rows = [0] * n_frames, list[list[int]]()
    tracks = zip(corner[starts][order].tolist(), starts[order].tolist(), counts[order].tolist(), strict=True)
    for of, start, count in tracks:
        if used[of]:
            continue
        # lists, since tracks are short: an operation on a few numbers takes an array longer
        numbers, frames = number[start : start + count].tolist(), frame[start : start + count].tolist()
        unused = [k for k in range(count) if not used[numbers[k]]]
        if len(unused) >= _MIN_VIEWS and min(tracks_per_frame[frames[k]] for k in unused) < _TRACKS:
            for k in unused:
                used[numbers[k]] = True
                tracks_per_frame[frames[k]] += 1
            rows.append([start + k for k in unused])
    if not rows:
        return Tracks(np.empty((0, 3)), np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
    every, point = np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(track) for track in rows])
    return Tracks(points[[track[0] for track in rows]], point, frame[every], plane[every])
