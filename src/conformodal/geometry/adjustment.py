"""Bundle adjustment of a map (Triggs et al. 2000): keyframe poses and focal length, held near the given poses.

Given poses have clock offsets, warps and noise of their own, which blur a map that believes them. Priors hold the
adjusted poses near the given ones, moved by the camera's mount; the standard deviations are learnt from the data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.core.robust import MAD_OF_NORMAL
from conformodal.geometry import cross_matrices

from .camera_fit import Mounted
from .settings import ADJUSTMENT
from .triangulation import Rays

_FIXED = 1e-9  # sigma of what does not change


class Tracks(NamedTuple):
    """Points, each seen by several frames at disjoint corners."""

    points: FloatArray  # (p, 3)
    point: IntArray  # (m,) 0 to p - 1, increasing: the point of each observation
    frame: IntArray  # (m,)
    plane: FloatArray  # (m, 2) on the plane at depth 1


class Adjusted(NamedTuple):
    """An adjusted camera, its poses ``T_world_cam`` (n, 4, 4), and the learnt sigmas of the given ones."""

    mounted: Mounted
    poses_cam: FloatArray
    sigmas: FloatArray  # (6,) radians in the camera's frame, and metres
    known_camera: bool = False  # whether focal length and mount are those of an earlier map, and stay


def choose_tracks(chunks: Sequence[tuple[Rays, FloatArray, BoolArray]], n_frames: int, tolerance: float) -> Tracks:
    """Long tracks, so many that each frame has enough: rays with the points (c, 3) of their corners and whether sound.

    A corner is in one track at most, so no observation counts twice.
    """
    parts = [(rays, *_agreeing(rays, points, sound, tolerance)) for rays, points, sound in chunks]
    own = np.concatenate([rays.seen[first][keep] for rays, first, keep in parts])
    seen = np.concatenate([rays.seen[keep] for rays, _, keep in parts])
    frame = np.concatenate([rays.camera[keep] for rays, _, keep in parts])
    plane = np.concatenate([rays.plane[keep] for rays, _, keep in parts])
    points = np.concatenate(
        [points[rays.corner[keep]] for (rays, _, keep), (_, points, _) in zip(parts, chunks, strict=True)]
    )
    starts = np.flatnonzero(np.diff(own, prepend=-1))
    counts = np.diff(np.append(starts, len(own)))
    used, taken = np.zeros(int(max(seen.max(initial=0), own.max(initial=0))) + 1, dtype=bool), np.zeros(n_frames, int)
    rows: list[IntArray] = []
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= ADJUSTMENT.least_views]
    for k, start, end in zip(own[starts[order]].tolist(), starts[order], (starts + counts)[order], strict=True):
        if used[k]:
            continue
        at = np.arange(start, end)[~used[seen[start:end]]]
        if len(at) >= ADJUSTMENT.least_views and taken[frame[at]].min() < ADJUSTMENT.tracks:
            used[seen[at]] = True
            taken[frame[at]] += 1
            rows.append(at)
    if not rows:
        return Tracks(np.empty((0, 3)), np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
    every, point = np.concatenate(rows), np.repeat(np.arange(len(rows)), [len(at) for at in rows])
    return Tracks(points[[at[0] for at in rows]], point, frame[every], plane[every])


def _agreeing(rays: Rays, points: FloatArray, sound: BoolArray, tolerance: float) -> tuple[IntArray, BoolArray]:
    """The first ray of each ray's corner, and which rays agree with its point."""
    first = np.flatnonzero(np.diff(rays.corner, prepend=-1))[rays.corner]
    R = rays.R_world_cam[rays.camera]
    local = np.einsum("mba,mb->ma", R, np.nan_to_num(points[rays.corner]) - rays.centres[rays.camera])
    ahead = local[:, 2] > 0
    plane = local[:, :2] / np.where(ahead, local[:, 2], 1.0)[:, None]
    return first, sound[rays.corner] & ahead & (np.linalg.norm(plane - rays.plane, axis=1) < tolerance)


def adjust(now: Adjusted, poses_se3: FloatArray, tracks: Tracks) -> Adjusted:
    """Adjust all by Levenberg-Marquardt with Cauchy weights, then learn the mount and the sigmas again."""
    bundle = _solve(
        _Bundle(now.poses_cam[:, :3, :3], now.poses_cam[:, :3, 3], tracks.points, 0.0), now, poses_se3, tracks
    )
    poses, camera, factor = now.poses_cam.copy(), now.mounted.camera, float(np.exp(bundle.log_focal))
    poses[:, :3, :3], poses[:, :3, 3] = bundle.R, bundle.centres
    relative = np.linalg.inv(poses_se3) @ poses
    mount = now.mounted.T_pose_cam.copy()
    if not now.known_camera:
        mount[:3, :3] = Rotation.from_matrix(relative[:, :3, :3]).mean().as_matrix()
        mount[:3, 3] = np.median(relative[:, :3, 3], axis=0)
    off = _deviations(bundle, poses_se3 @ mount)
    spread = np.repeat([np.median(np.abs(off[:, :3])), np.median(np.abs(off[:, 3:]))], 3) / MAD_OF_NORMAL
    focused = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    mounted = now.mounted if now.known_camera else now.mounted._replace(camera=focused, T_pose_cam=mount)
    return now._replace(
        mounted=mounted, poses_cam=poses, sigmas=np.maximum(spread, ADJUSTMENT.least_sigma * now.sigmas)
    )


def given_frame_errors(adjusted: Adjusted, poses_se3: FloatArray) -> FloatArray:
    """Errors (n, 6) of adjusted poses in the given frame: metres and a rotation vector, world."""
    poses = adjusted.poses_cam @ np.linalg.inv(adjusted.mounted.T_pose_cam)
    turns = Rotation.from_matrix(poses[:, :3, :3] @ np.swapaxes(poses_se3[:, :3, :3], 1, 2)).as_rotvec()
    return np.concatenate((poses[:, :3, 3] - poses_se3[:, :3, 3], turns), axis=1)


class _Bundle(NamedTuple):
    R: FloatArray  # (n, 3, 3) R_world_cam
    centres: FloatArray  # (n, 3)
    points: FloatArray  # (p, 3)
    log_focal: float  # change of the focal length


class _Residuals(NamedTuple):
    local: FloatArray  # (m, 3) points in the frame of the camera that sees them
    pixels: FloatArray  # (m, 2)
    priors: FloatArray  # (n, 6) in sigmas
    cost: float


def _deviations(bundle: _Bundle, prior: FloatArray) -> FloatArray:
    turns = Rotation.from_matrix(np.swapaxes(prior[:, :3, :3], 1, 2) @ bundle.R).as_rotvec()
    return np.concatenate((turns, bundle.centres - prior[:, :3, 3]), axis=1)


def _solve(bundle: _Bundle, now: Adjusted, poses_se3: FloatArray, tracks: Tracks) -> _Bundle:
    prior, focal = poses_se3 @ now.mounted.T_pose_cam, (now.mounted.camera.fx + now.mounted.camera.fy) / 2
    sigma_focal = _FIXED if now.known_camera else ADJUSTMENT.sigma_focal

    def residuals(its: _Bundle) -> _Residuals:
        local = np.einsum("mba,mb->ma", its.R[tracks.frame], its.points[tracks.point] - its.centres[tracks.frame])
        ahead = np.maximum(local[:, 2:], 1e-6)
        pixels = (local[:, :2] / ahead * np.exp(its.log_focal) - tracks.plane) * focal
        priors = _deviations(its, prior) / now.sigmas
        cost = np.log1p((pixels**2).sum(axis=1)).sum() + (priors**2).sum() + (its.log_focal / sigma_focal) ** 2
        return _Residuals(local, pixels, priors, float(cost))

    found, damping = residuals(bundle), 1e-4
    for _ in range(ADJUSTMENT.iterations):
        system = _System.of(bundle, found, tracks, now.sigmas, focal, sigma_focal)
        for _ in range(ADJUSTMENT.dampings):
            after = system.step(bundle, damping)
            its = residuals(after)
            if its.cost <= found.cost:
                damping = max(damping / 10, 1e-9)
                break
            damping *= 10
        else:
            return bundle
        enough = found.cost - its.cost <= ADJUSTMENT.enough * found.cost
        bundle, found = after, its
        if enough:
            break
    return bundle


class _System(NamedTuple):
    """Normal equations of frames (6 each), points (3 each) and focal length, and their gradients."""

    frames: FloatArray  # (n, 6, 6)
    points: FloatArray  # (p, 3, 3)
    between: FloatArray  # (m, 6, 3) of a frame and a point, sorted by frame
    focal: float
    focal_frames: FloatArray  # (n, 6)
    focal_points: FloatArray  # (p, 3)
    pull_frames: FloatArray
    pull_points: FloatArray
    pull_focal: float
    point: IntArray  # (m,) sorted by frame
    starts: IntArray  # (n + 1,) first observation of each frame

    @classmethod
    def of(
        cls,
        bundle: _Bundle,
        found: _Residuals,
        tracks: Tracks,
        sigmas: FloatArray,
        focal: float,
        sigma_focal: float,
    ) -> _System:
        order = np.argsort(tracks.frame, kind="stable")
        n, frame, point = len(bundle.R), tracks.frame[order], tracks.point[order]
        x, y, z = found.local[order].T
        z, grown = np.maximum(z, 1e-6), np.exp(bundle.log_focal)
        pixels = found.pixels[order]
        root = 1 / np.sqrt(1 + (pixels**2).sum(axis=1))
        scale = root * focal * grown / z
        by_place = np.zeros((len(z), 2, 3))
        by_place[:, 0, 0] = by_place[:, 1, 1] = scale
        by_place[:, 0, 2], by_place[:, 1, 2] = -scale * x / z, -scale * y / z
        by_point = by_place @ np.swapaxes(bundle.R[frame], 1, 2)
        by_frame = np.concatenate((by_place @ cross_matrices(np.stack((x, y, z), axis=1)), -by_point), axis=2)
        by_focal, weighted = np.stack((scale * x, scale * y), axis=1), pixels * root[:, None]
        starts = np.searchsorted(frame, np.arange(n + 1))
        p, turned = len(bundle.points), np.swapaxes(by_point, 1, 2)
        frames = _summed(np.swapaxes(by_frame, 1, 2) @ by_frame, frame, n) + np.diag(1 / sigmas**2)
        pull_frames = _summed(np.einsum("mka,mk->ma", by_frame, weighted), frame, n) + found.priors / sigmas
        return cls(
            frames=frames,
            points=_summed(turned @ by_point, point, p),
            between=np.swapaxes(by_frame, 1, 2) @ by_point,
            focal=float((by_focal**2).sum()) + 1 / sigma_focal**2,
            focal_frames=_summed(np.einsum("mka,mk->ma", by_frame, by_focal), frame, n),
            focal_points=_summed(np.einsum("mka,mk->ma", by_point, by_focal), point, p),
            pull_frames=pull_frames,
            pull_points=_summed(np.einsum("mka,mk->ma", by_point, weighted), point, p),
            pull_focal=float((by_focal * weighted).sum()) + bundle.log_focal / sigma_focal**2,
            point=point,
            starts=starts,
        )

    def step(self, bundle: _Bundle, damping: float) -> _Bundle:
        """The bundle after a damped step.

        The Schur complement removes the points; conjugate gradients solve for the rest, with the frames' own blocks as
        the preconditioner (Agarwal et al. 2010). Its matrix is never formed, which would take most of the time.
        """
        n, p = len(self.frames), len(self.points)
        diagonal = np.einsum("mii->mi", self.points)[:, None] * np.eye(3)
        inverse = np.linalg.inv(self.points + damping * diagonal + 1e-9 * np.eye(3))
        shape, through_points = (6 * n, 3 * p), self.between @ inverse[self.point]
        through = sparse.bsr_array((through_points, self.point, self.starts), shape=shape).tocsr()
        back = sparse.bsr_array((self.between, self.point, self.starts), shape=shape).T.tocsr()
        damped = self.frames + damping * np.einsum("mii->mi", self.frames)[:, None] * np.eye(6)
        led = np.einsum("pab,pb->pa", inverse, self.focal_points)
        corner = self.focal * (1 + damping) - (led * self.focal_points).sum()
        border = self.focal_frames.ravel() - through @ self.focal_points.ravel()
        pull = np.append(
            self.pull_frames.ravel() - through @ self.pull_points.ravel(),
            self.pull_focal - (led * self.pull_points).sum(),
        )
        frame = np.repeat(np.arange(n), np.diff(self.starts))
        own = np.linalg.inv(damped - _summed(through_points @ np.swapaxes(self.between, 1, 2), frame, n))

        def product(move: FloatArray) -> FloatArray:
            frames = np.einsum("nab,nb->na", damped, move[:-1].reshape(n, 6)).ravel() - through @ (back @ move[:-1])
            return np.append(frames + border * move[-1], border @ move[:-1] + corner * move[-1])

        def each_alone(pull: FloatArray) -> FloatArray:
            return np.append(np.einsum("nab,nb->na", own, pull[:-1].reshape(n, 6)).ravel(), pull[-1] / corner)

        size = (6 * n + 1, 6 * n + 1)
        move, _ = cg(
            LinearOperator(size, product, dtype=np.float64),
            -pull,
            rtol=ADJUSTMENT.solved,
            maxiter=ADJUSTMENT.solving,
            M=LinearOperator(size, each_alone, dtype=np.float64),
        )
        left = self.pull_points + self.focal_points * move[-1] + (back @ move[:-1]).reshape(p, 3)
        turn, shift = np.split(move[:-1].reshape(n, 6), 2, axis=1)
        return _Bundle(
            bundle.R @ Rotation.from_rotvec(turn).as_matrix(),
            bundle.centres + shift,
            bundle.points - np.einsum("pab,pb->pa", inverse, left),
            bundle.log_focal + float(move[-1]),
        )


def _summed(blocks: FloatArray, onto: IntArray, count: int) -> FloatArray:
    """Sums (count, ...) of the blocks (m, ...) with each number in `onto` (m,)."""
    rows = sparse.csr_array((np.ones(len(onto)), (onto, np.arange(len(onto)))), shape=(count, len(onto)))
    return np.asarray(rows @ blocks.reshape(len(blocks), -1)).reshape(count, *blocks.shape[1:])
