"""The peer of benchmarks/recordings.py: pycolmap with SIFT, a map from given poses and PnP with covariance.

pip install -r benchmarks/peers/recordings.txt. Settings were chosen with fr1_desk answered from fr1_xyz.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation
from sklearn.cluster import KMeans

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.io import Recording

EVERY, KEYPOINTS, WORDS, RETRIEVED, MIN_INLIERS = 3, 2000, 64, 10, 12
RATIO, PAIRED, APART_M, TURNED_RAD = 0.8, 10, 0.05, np.radians(35.0)
IN_TIME = (1, 2, 4)


class Features(NamedTuple):
    """SIFT features of an image, without distortion."""

    pixels: FloatArray  # (n, 2) centres of pixels are whole numbers
    descriptors: FloatArray  # (n, 128) of length 1, so that products are cosines


class PeerMap(NamedTuple):
    """Points that n map images see, and what an image is retrieved by."""

    starts: IntArray  # (n + 1,) points of image i are starts[i] to starts[i + 1]
    descriptors: FloatArray  # (N, 128)
    points_xyz: FloatArray  # (N, 3)
    words: FloatArray  # (64, 128)
    vlads: FloatArray  # (n, 8192)
    mount: FloatArray  # (3,) from the camera's centre to the given position, in the camera's frame
    focal: FloatArray  # (2,)
    seconds: FloatArray  # () CPU time that the map took

    @property
    def megabytes(self) -> float:
        """Descriptors in bytes, points and what images are retrieved by in single precision."""
        return (self.descriptors.size + 4 * (self.points_xyz.size + self.words.size + self.vlads.size)) / 1e6


class PeerAnswers(NamedTuple):
    """Positions of m images, NaN where they were not localised, their covariances, and CPU time."""

    positions_xyz: FloatArray  # (m, 3)
    covariances: FloatArray  # (m, 3, 3)
    ms: FloatArray  # (m,) without reading the image


def build_map(mapped: Recording, folder: Path) -> PeerMap:
    """Map of a recording, whose poses are refined; kept in a folder."""
    if not (folder / "map.npz").is_file():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(folder / "map.npz", **_built(mapped, folder)._asdict())
    return PeerMap(**np.load(folder / "map.npz"))


def answers(peer: PeerMap, new: Recording, frames: IntArray) -> PeerAnswers:
    """Localise images of a recording, each image alone."""
    sift, n = _sift(), len(frames)
    results = PeerAnswers(np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), np.zeros(n))
    for k, i in enumerate(frames.tolist()):
        image, began = new.image(i), time.process_time()
        estimate = _localized(peer, _camera(new, peer.focal), _features(sift, image, new))
        if estimate is not None:
            results.positions_xyz[k], results.covariances[k] = estimate
        results.ms[k] = 1e3 * (time.process_time() - began)
    return results


def _sift() -> Any:
    pycolmap.set_random_seed(0)
    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    options.sift.max_num_features = KEYPOINTS
    return pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)


def _features(sift: Any, image: Any, sequence: Recording) -> Features:
    keypoints, descriptors = sift.extract_from_uint8_array(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    pixels = pycolmap.keypoints_to_matrix(keypoints)[:, :2].astype(float) - 0.5  # COLMAP counts from the corner
    rows = np.asarray(descriptors.data, np.float32)
    return Features(sequence.camera.undistort(pixels), rows / np.linalg.norm(rows, axis=1, keepdims=True))


def _camera(sequence: Recording, focal: FloatArray) -> Any:
    camera = sequence.camera
    parameters = [*focal, camera.cx + 0.5, camera.cy + 0.5]
    return pycolmap.Camera(model="PINHOLE", width=camera.width, height=camera.height, params=parameters, camera_id=1)


def _matched(one: FloatArray, other: FloatArray) -> IntArray:
    """Mutual matches (m, 2) by Lowe's ratio."""
    if len(one) < 2 or len(other) < 2:
        return np.empty((0, 2), np.int64)
    cosines = one @ other.T
    every, back = np.arange(len(one)), cosines.argmax(axis=0)
    nearest = cosines.argmax(axis=1)
    first = cosines[every, nearest]
    cosines[every, nearest] = -1
    sure = 1 - first < RATIO**2 * (1 - cosines.max(axis=1))  # squared distances are twice these
    rows = np.flatnonzero(sure & (back[nearest] == every))
    return np.column_stack((rows, nearest[rows]))


def _pairs(poses_se3: FloatArray) -> list[tuple[int, int]]:
    """Neighbours in time, and those by pose that have parallax."""
    n, pairs = len(poses_se3), set()
    for i, pose in enumerate(poses_se3):
        pairs |= {(i, i + step) for step in IN_TIME if i + step < n}
        apart = np.linalg.norm(poses_se3[:, :3, 3] - pose[:3, 3], axis=1)
        turned = np.arccos(np.clip(poses_se3[:, :3, 2] @ pose[:3, 2], -1, 1))
        others = np.flatnonzero((apart > APART_M) & (turned < TURNED_RAD))
        best = others[np.argsort(apart[others] + turned[others], kind="stable")[:PAIRED]]
        pairs |= {(min(i, j), max(i, j)) for j in best.tolist()}
    return sorted(pairs)


def _built(mapped: Recording, folder: Path) -> PeerMap:
    began, frames = time.process_time(), mapped.posed[::EVERY]
    poses_se3 = mapped.poses.poses_se3[::EVERY]
    sift, camera = _sift(), _camera(mapped, np.array([mapped.camera.fx, mapped.camera.fy]))
    features = [_features(sift, mapped.image(i), mapped) for i in frames.tolist()]
    rough = pycolmap.Reconstruction()
    rough.add_camera_with_trivial_rig(camera)
    (folder / "database.db").unlink(missing_ok=True)
    pairs = _pairs(poses_se3)
    (folder / "pairs.txt").write_text("".join(f"{i}.jpg {j}.jpg\n" for i, j in pairs))
    with pycolmap.Database.open(folder / "database.db") as database:
        database.write_camera(camera, use_camera_id=True)
        database.write_rig(rough.rigs[1], use_rig_id=True)
        for i, (feature, pose) in enumerate(zip(features, poses_se3, strict=True)):
            image = pycolmap.Image(f"{i}.jpg", feature.pixels + 0.5, camera_id=1, image_id=i + 1)
            turn = Rotation.from_matrix(pose[:3, :3].T)
            T_cam_world = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), -turn.apply(pose[:3, 3]))
            rough.add_image_with_trivial_frame(image, T_cam_world)
            database.write_frame(rough.frames[i + 1], use_frame_id=True)
            database.write_image(rough.images[i + 1], use_image_id=True)
            database.write_keypoints(i + 1, (feature.pixels + 0.5).astype(np.float32))
        for i, j in pairs:
            database.write_matches(i + 1, j + 1, _matched(features[i].descriptors, features[j].descriptors))
    pycolmap.verify_matches(folder / "database.db", folder / "pairs.txt")
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, extract_colors=False)
    (folder / "sparse").mkdir(exist_ok=True)
    model = pycolmap.triangulate_points(rough, folder / "database.db", folder, folder / "sparse", options=options)
    words = KMeans(WORDS, n_init=1, random_state=0, max_iter=30).fit(
        np.concatenate([each.descriptors[::10] for each in features])
    )
    vlads = np.array([_vlad(words.cluster_centers_, each.descriptors) for each in features])

    for poses in (False, True):  # focal length and points, then poses, too
        pycolmap.bundle_adjustment(
            model,
            pycolmap.BundleAdjustmentOptions(
                refine_rig_from_world=poses, refine_extra_params=False, refine_focal_length=True, print_summary=False
            ),
        )
    centres = np.array([model.images[i + 1].projection_center().ravel() for i in range(len(frames))])
    model.transform(pycolmap.estimate_sim3d(centres, poses_se3[:, :3, 3]))
    return _kept(model, features, poses_se3, words.cluster_centers_, vlads, time.process_time() - began)


def _kept(
    model: Any, features: list[Features], poses_se3: FloatArray, words: FloatArray, vlads: FloatArray, seconds: float
) -> PeerMap:
    rows, points, counts, off = [], [], [0], []
    for i, feature in enumerate(features):
        image = model.images[i + 1]
        triangulated = [(k, p.point3D_id) for k, p in enumerate(image.points2D) if p.has_point3D()]
        rows.append(feature.descriptors[[k for k, _ in triangulated]])
        points += [model.points3D[p].xyz for _, p in triangulated]
        counts.append(len(triangulated))
        off.append(image.cam_from_world().rotation.matrix() @ (poses_se3[i, :3, 3] - image.projection_center().ravel()))
    focal = model.cameras[1].params[:2]
    every = np.concatenate(rows), np.array(points), words, vlads.astype(np.float32), np.median(off, axis=0), focal
    return PeerMap(np.cumsum(counts), *every, np.array(seconds))


def _vlad(words: FloatArray, descriptors: FloatArray) -> FloatArray:
    """The vector of locally aggregated descriptors (Jegou et al. 2010), with square roots."""
    word = (descriptors @ words.T - (words**2).sum(axis=1) / 2).argmax(axis=1)
    off = descriptors - words[word]
    vector = np.array([off[word == k].sum(axis=0) for k in range(len(words))])
    vector /= np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-9)
    return np.asarray(vector.ravel() / np.linalg.norm(vector))


def _localized(peer: PeerMap, camera: Any, features: Features) -> tuple[FloatArray, FloatArray] | None:
    """Position (3,) and covariance (3, 3) of an image."""
    near = np.argsort(-(peer.vlads @ _vlad(peer.words, features.descriptors)), kind="stable")[:RETRIEVED]
    matches = []
    for i in near.tolist():
        points = slice(peer.starts[i], peer.starts[i + 1])
        matches.append(np.add(_matched(features.descriptors, peer.descriptors[points]), (0, points.start)))
    rows, landmarks = np.concatenate(matches).T
    # several map images see the same point: it counts once
    _, first = np.unique(np.column_stack((rows, peer.points_xyz[landmarks])), axis=0, return_index=True)
    rows, landmarks = rows[first], landmarks[first]
    estimate = pycolmap.estimate_and_refine_absolute_pose(
        features.pixels[rows] + 0.5, peer.points_xyz[landmarks], camera, return_covariance=True
    )
    if estimate is None or len(np.unique(rows[estimate["inlier_mask"]])) < MIN_INLIERS:
        return None
    return _position(estimate["cam_from_world"], np.asarray(estimate["covariance"]), peer.mount)


def _position(T_cam_world: Any, covariance: FloatArray, mount: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Position of the mount and its covariance; the rotation's is in half angles, before the rotation."""
    R, t = T_cam_world.rotation.matrix(), T_cam_world.translation
    x, y, z = t - mount
    turned = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    slopes = np.hstack((2 * R.T @ turned, R.T))
    return R.T @ (mount - t), slopes @ covariance @ slopes.T
