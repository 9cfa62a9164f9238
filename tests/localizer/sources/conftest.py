"""A world of points, each with a descriptor of its own, seen by cameras whose poses are known exactly."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.features.local import LocalFeatures
from conformodal.geometry import PinholeCamera

CAMERA = PinholeCamera(500, 500, 320, 240, 640, 480)
DEPTH = 4.0


@dataclass
class World:
    """Poses are those of a rig; the camera is mounted on it and has another focal length than it is said to have."""

    poses_se3: np.ndarray
    points: np.ndarray
    descriptors: np.ndarray
    camera: PinholeCamera
    T_pose_cam: np.ndarray

    def see(self, pose, seed=0, noise_px=0.3, wrong=0.0):
        """What a camera at a pose sees; a share of the descriptors changes hands."""
        rng = np.random.default_rng(seed)
        T = pose @ self.T_pose_cam
        local = (self.points - T[:3, 3]) @ T[:3, :3]
        pixels = local[:, :2] / local[:, 2:] * self.camera.fx + (self.camera.cx, self.camera.cy)
        there = np.flatnonzero((local[:, 2] > 0.5) & (pixels > 0).all(axis=1) & (pixels < (640, 480)).all(axis=1))
        there = rng.permutation(there)[:400]
        descriptors = self.descriptors[there].copy()
        swapped = np.flatnonzero(rng.random(len(there)) < wrong)
        descriptors[swapped] = descriptors[rng.permutation(swapped)]
        descriptors ^= np.packbits(rng.random((len(there), 256)) < 0.03, axis=1)  # no corner looks the same twice
        # a stand-in for a blurry picture: smooth in the pose
        waves = np.random.default_rng(5).normal(size=(768, 6))
        around = np.concatenate((T[:3, 3] / DEPTH, Rotation.from_matrix(T[:3, :3]).as_rotvec()))
        picture = np.cos(waves @ around + np.arange(768)).astype(np.float32)
        picture -= picture.mean()
        picture /= np.linalg.norm(picture)
        return LocalFeatures(pixels[there] + rng.normal(size=(len(there), 2)) * noise_px, descriptors, picture)

    def local_features(self, **how):
        return [self.see(pose, seed=10 + i, **how) for i, pose in enumerate(self.poses_se3)]


def poses_along(n, seed=0, sideways=2.5):
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, n)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, 3] = np.column_stack((sideways * (t - 0.5), 0.3 * np.sin(9 * t), 0.4 * np.cos(7 * t)))
    poses[:, :3, 3] += 0.05 * rng.normal(size=(n, 3))
    turns = np.column_stack((0.1 * np.sin(5 * t), -0.3 * (t - 0.5), 0.2 * np.sin(3 * t)))
    poses[:, :3, :3] = Rotation.from_rotvec(turns + 0.02 * rng.normal(size=(n, 3))).as_matrix()
    return poses


def make_world(n=60, factor=1.0, turn=(0, 0, 0), place=(0, 0, 0), seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-5, -3, 3], [5, 3, 6], (1500, 3))
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    camera = replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)
    descriptors = rng.integers(0, 256, (len(points), 32), dtype=np.uint8)
    return World(poses_along(n, seed), points, descriptors, camera, mount)


@pytest.fixture
def world_of():
    return make_world


@pytest.fixture
def stated_camera():
    return CAMERA


@pytest.fixture
def depth_m():
    return DEPTH
