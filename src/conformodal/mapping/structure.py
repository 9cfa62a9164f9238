"""Poses of keyframes, points and cameras from verified matches, by pycolmap's mappers."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.parallel import thread_limit
from conformodal.core.progress import StageProgress
from conformodal.geometry import PinholeCamera, PoseError
from conformodal.io.diagnosis.cameras import doubt_camera

from .keyframes import SIDE_PX
from .matching import MatchedImages, opened
from .settings import MapError, MapSettings, require_pycolmap

_STAGE = "mapping"
_MAX_ITERATIONS = 50
_MAX_ERROR_PX, _MIN_ANGLE_DEG = 4.0, 1.5  # of points that are kept
_OFF_CENTRE = 0.1  # of a side: a principal point farther from the middle is not believed


@dataclass(frozen=True, eq=False)
class Structure:
    """A map of keyframes.

    Attributes
    ----------
    model
        The pycolmap reconstruction of the largest piece.
    pieces
        Names of the keyframes in each piece, the largest first.
    incremental
        Whether the incremental mapper had to add keyframes.
    """

    model: Any
    pieces: tuple[frozenset[str], ...]
    incremental: bool

    @property
    def poses(self) -> dict[str, FloatArray]:
        """``T_world_cam`` (4, 4) of the keyframes."""
        return {image.name: world_from_camera(image.cam_from_world()) for image in _registered(self.model)}

    @property
    def depth(self) -> float:
        """Median distance from the cameras to the points that they see."""
        centres = {key: image.projection_center() for key, image in self.model.images.items() if image.has_pose}
        seen = [
            (point.xyz, centres[e.image_id]) for point in self.model.points3D.values() for e in point.track.elements
        ]
        away = np.linalg.norm(np.array([xyz - centre for xyz, centre in seen]).reshape(-1, 3), axis=1)
        return float(np.median(away)) if len(away) else 1.0

    def camera_of(self, name: str) -> Any:
        """The pycolmap camera of a keyframe."""
        image = self.model.find_image_with_name(name)
        return self.model.cameras[image.camera_id]


def world_from_camera(cam_from_world: Any) -> FloatArray:
    """``T_world_cam`` (4, 4) of a pycolmap pose."""
    pose = np.eye(4)
    pose[:3] = cam_from_world.inverse().matrix()
    return pose


def pinhole(camera: Any) -> PinholeCamera:
    """A pycolmap camera; COLMAP's first pixel has its centre at (0.5, 0.5), OpenCV's at (0, 0)."""
    given = [float(value) for value in camera.params]
    if camera.model.name == "SIMPLE_RADIAL":
        f, cx, cy, k1 = given
        given = [f, f, cx, cy, k1, 0.0, 0.0, 0.0]
    fx, fy, cx, cy, *lens = given
    distortion = tuple(lens[:5]) if len(lens) > 4 else tuple(lens)
    return PinholeCamera(fx, fy, cx - 0.5, cy - 0.5, camera.width, camera.height, distortion if any(lens) else ())


def reconstruct(
    matched: MatchedImages, work: Path, settings: MapSettings, report: StageProgress | None = None
) -> Structure:
    """Map the keyframes: all at once, then one after the other those that are left out.

    Cameras whose calibration is known are kept; the others' focal lengths, principal points and distortion are fitted.
    """
    pycolmap = require_pycolmap()
    steps = 4

    def done(step: int) -> None:
        if report is not None:
            report(_STAGE, step, steps)

    done(0)
    with opened(matched.database) as handle:
        n_images, n_cameras = handle.num_images(), handle.num_cameras()
        known = {key: list(handle.read_camera(key).params) for key in matched.known_cameras}
    fit_cameras = len(known) < n_cameras
    if fit_cameras:
        pycolmap.calibrate_view_graph(matched.database)
    done(1)
    models = _map_globally(matched, work / "global", settings, fit_cameras=fit_cameras)
    done(2)
    best, incremental = _largest(models), False
    if best is None or best.num_reg_images() < n_images:
        more = _map_incrementally(matched, work, best, settings, fit_cameras=fit_cameras)
        if more is not None and (best is None or more.num_reg_images() > best.num_reg_images()):
            best, incremental = more, True
    done(3)
    if best is None:
        raise MapError("no keyframes could be joined: record more slowly, with overlapping views and the light on")
    for key in known.keys() & set(best.cameras):  # which the mappers may have fitted with the others
        best.cameras[key].params = known[key]
    adjust(best, known.keys() & set(best.cameras))
    done(4)
    inside = frozenset(image.name for image in _registered(best))
    others = [frozenset(image.name for image in _registered(model)) - inside for model in models]
    pieces = [inside, *sorted(filter(None, others), key=len, reverse=True)]
    return Structure(best, tuple(pieces), incremental)


def _registered(model: Any) -> list[Any]:
    return [image for image in model.images.values() if image.has_pose]


def _largest(models: list[Any]) -> Any:
    return max(models, key=lambda model: model.num_reg_images(), default=None)


def _map_globally(matched: MatchedImages, out: Path, settings: MapSettings, *, fit_cameras: bool) -> list[Any]:
    """All keyframes at once: averages of rotations, then positions (GLOMAP, Pan et al. 2024)."""
    pycolmap = require_pycolmap()
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = thread_limit(), settings.seed
    options.min_num_matches = settings.min_matches
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_extra_params = fit_cameras
    out.mkdir()
    return list(pycolmap.global_mapping(matched.database, matched.images, out, options).values())


def _map_incrementally(
    matched: MatchedImages, work: Path, start: Any, settings: MapSettings, *, fit_cameras: bool
) -> Any:
    """The largest model of one keyframe after the other, from a model on if there is one."""
    pycolmap = require_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = thread_limit(), settings.seed
    options.min_num_matches = settings.min_matches
    options.ba_refine_focal_length = options.ba_refine_extra_params = fit_cameras
    options.multiple_models, options.extract_colors = False, False
    given = {}
    if start is not None:
        begin = work / "begin"
        begin.mkdir()
        start.write(begin)
        given["input_path"] = begin
    out = work / "incremental"
    out.mkdir()
    return _largest(
        list(pycolmap.incremental_mapping(matched.database, matched.images, out, options, **given).values())
    )


def adjust(model: Any, kept: Collection[int]) -> None:
    """Bundle adjustment with all of the lens; where that gives no camera that exists, with less of it.

    `kept` are cameras that are known, and stay as they are.
    """
    pycolmap = require_pycolmap()
    free = set(model.cameras) - set(kept)
    before = pycolmap.Reconstruction(model)
    for key in free:
        _free_lens(model.cameras[key])
    _adjust_bundle(model, kept, refine_centre=bool(free))
    if not all(_is_likely(model.cameras[key]) for key in free):
        _restore(model, before)
        _adjust_bundle(model, kept, refine_centre=False)
    filter_points(model)
    model.update_point_3d_errors()


def filter_points(model: Any) -> None:
    """Remove observations with large errors, at the size of their own images, and points of narrow angles."""
    manager = require_pycolmap().ObservationManager(model)
    for image, points, errors in reprojection_errors(model):
        side = max(image.camera.width, image.camera.height)
        for point in points[errors > _MAX_ERROR_PX * max(1.0, side / SIDE_PX)].tolist():
            if image.points2D[point].has_point3D():  # its point may have gone with another observation
                manager.delete_observation(image.image_id, point)
    manager.filter_all_points3D(np.inf, _MIN_ANGLE_DEG)


def reprojection_errors(model: Any) -> list[tuple[Any, IntArray, FloatArray]]:
    """Images with their observed points (n,) and the errors of these (n,) in pixels; infinite behind the camera."""
    found = list[tuple[Any, IntArray, FloatArray]]()
    for image in _registered(model):
        points = np.array(image.get_observation_point2D_idxs(), dtype=np.int64)
        seen = image.get_observation_points2D()
        if len(points):
            xyz = np.array([model.points3D[point.point3D_id].xyz for point in seen])
            pose = image.cam_from_world().matrix()
            in_camera = xyz @ pose[:, :3].T + pose[:, 3]
            pixels = image.camera.img_from_cam(in_camera, check_cheirality=False)
            errors = np.linalg.norm(pixels - np.array([point.xy for point in seen]), axis=1)
            found.append((image, points, np.where(in_camera[:, 2] > 0, errors, np.inf)))
    return found


def _restore(model: Any, before: Any) -> None:
    """Give a model the poses, points and cameras that it had before."""
    for key, frame in before.frames.items():
        if frame.has_pose():
            model.frames[key].rig_from_world = frame.rig_from_world
    for key, point in before.points3D.items():
        model.points3D[key].xyz = point.xyz
    for key, camera in before.cameras.items():
        model.cameras[key].model, model.cameras[key].params = camera.model, camera.params


def _free_lens(camera: Any) -> None:
    """OpenCV's model: two focal lengths, radial and tangential distortion."""
    if camera.model.name == "SIMPLE_RADIAL":
        f, cx, cy, k1 = camera.params
        camera.model = require_pycolmap().CameraModelId.OPENCV
        camera.params = [f, f, cx, cy, k1, 0.0, 0.0, 0.0]


def _adjust_bundle(model: Any, kept: Collection[int], *, refine_centre: bool) -> None:
    """Bundle adjustment with a robust loss; `kept` are cameras that stay as they are."""
    pycolmap = require_pycolmap()
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = refine_centre
    options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    options.ceres.solver_options.max_num_iterations = _MAX_ITERATIONS
    options.ceres.solver_options.num_threads = thread_limit()
    config = pycolmap.BundleAdjustmentConfig()
    for image in _registered(model):
        config.add_image(image.image_id)
    for key in kept:
        config.set_constant_cam_intrinsics(key)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _is_likely(camera: Any) -> bool:
    """Whether a fitted camera exists and has its principal point near the middle."""
    try:
        fitted = pinhole(camera)
    except PoseError:
        return False
    doubts = doubt_camera(fitted)
    off = abs(fitted.cx / fitted.width - 0.5), abs(fitted.cy / fitted.height - 0.5)
    return not doubts.impossible and not doubts.unlikely and max(off) < _OFF_CENTRE
