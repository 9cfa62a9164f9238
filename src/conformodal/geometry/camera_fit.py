"""Camera calibration from known poses: focal length, shutter, and the camera's pose on the rig whose poses are given.

The poses of a data set are often those of another sensor (7-Scenes gives the depth camera's), and its focal length is
nominal; both distort a map. Matches between frames must lie on epipolar lines, which determines nine unknowns.
Two are the shutter's: rows that are read one after the other bend the picture of a moving camera, and clocks differ.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.geometry import PinholeCamera, rigid_motions

NO_DELAY = np.zeros(2)
_MOST, _LEAST = 10000, 400  # matches: half are fitted, half check the fit
_SCALE_PX = 1.5  # of the Cauchy loss
# prior standard deviations: of the logarithm of the focal length, of the mount's angles and of its position in scene
# depths, and of the shutter's delays
_SIGMA_LOG_FOCAL, _SIGMA_MOUNT_RAD, _SIGMA_MOUNT_DEPTHS, _SIGMA_S = 0.2, 0.05, 0.05, 0.02
_MOST_SIGMAS = 3.0  # further off, the poses do not belong to the images


class Matches(NamedTuple):
    """Corners seen by two frames."""

    frames: IntArray  # (m, 2)
    pixels: FloatArray  # (m, 2, 2) undistorted, in the one and in the other
    flows: FloatArray  # (m, 2, 2) of the same, pixels per second


class Mounted(NamedTuple):
    """A camera without distortion, and ``T_pose_cam`` (4, 4) from its frame to the one whose poses are given."""

    camera: PinholeCamera
    T_pose_cam: FloatArray
    shutter: FloatArray = NO_DELAY  # (2,), see PinholeCamera.at_pose_time


def fit_camera(matches: Matches, poses_se3: FloatArray, camera: PinholeCamera, depth_m: float) -> Mounted:
    """The camera with the smallest epipolar errors of matches, by robust least squares.

    It is fitted to half of the matches. Where it does not reduce the errors of the other half, or is far from the given
    one, the given one is returned. Delays that are out of range are left out, and the rest is judged without them.
    """
    given = Mounted(replace(camera, distortion=()), np.eye(4))
    if len(matches.frames) < _LEAST:
        return given
    order = np.random.default_rng(0).permutation(len(matches.frames))[:_MOST]
    fitted, checked = (
        Matches(matches.frames[half], matches.pixels[half], matches.flows[half]) for half in np.array_split(order, 2)
    )
    mount_m = _SIGMA_MOUNT_DEPTHS * depth_m
    sigmas = _SIGMA_LOG_FOCAL, _SIGMA_MOUNT_RAD, mount_m, _SIGMA_S
    spreads = np.repeat(sigmas, (1, 3, 3, 2))

    def residuals(unknowns: FloatArray) -> FloatArray:
        errors = _epipolar_errors_px(_mounted(given, unknowns * spreads), fitted, poses_se3)
        return np.concatenate((errors / _SCALE_PX, unknowns))

    unknowns = least_squares(residuals, np.zeros(9), loss="cauchy", max_nfev=30).x
    if np.abs(unknowns[7:]).max() >= _MOST_SIGMAS:
        unknowns[7:] = 0
    better = _mounted(given, unknowns * spreads)
    before, after = (float(np.median(np.abs(_epipolar_errors_px(m, checked, poses_se3)))) for m in (given, better))
    return better if after < before and np.abs(unknowns).max() < _MOST_SIGMAS else given


def _mounted(given: Mounted, unknowns: FloatArray) -> Mounted:
    factor = float(np.exp(unknowns[0]))
    T_pose_cam = rigid_motions(Rotation.from_rotvec(unknowns[1:4]).as_matrix(), unknowns[4:7])
    camera = given.camera
    return Mounted(replace(camera, fx=camera.fx * factor, fy=camera.fy * factor), T_pose_cam, unknowns[7:])


def _epipolar_errors_px(mounted: Mounted, matches: Matches, poses_se3: FloatArray) -> FloatArray:
    """Signed first-order distances (m,) from the epipolar constraint, in pixels (Sampson)."""
    camera = mounted.camera
    poses = poses_se3 @ mounted.T_pose_cam
    (Ri, ci), (Rj, cj) = ((poses[f, :3, :3], poses[f, :3, 3]) for f in matches.frames.T)
    plane = camera.on_plane(camera.at_pose_time(matches.pixels, matches.flows, mounted.shutter))
    rays = np.concatenate((plane, np.ones((*plane.shape[:2], 1))), axis=2)
    baseline = np.einsum("mba,mb->ma", Rj, ci - cj)
    line_j = np.cross(baseline, np.einsum("mba,mbc,mc->ma", Rj, Ri, rays[:, 0]))
    line_i = np.einsum("mba,mbc,mc->ma", Ri, Rj, np.cross(rays[:, 1], baseline))
    squares = line_j[:, 0] ** 2 + line_j[:, 1] ** 2 + line_i[:, 0] ** 2 + line_i[:, 1] ** 2
    distance = (line_j * rays[:, 1]).sum(axis=1) / np.sqrt(np.maximum(squares, 1e-18))
    return np.asarray(distance * (camera.fx + camera.fy) / 2)
