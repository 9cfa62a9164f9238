"""COLMAP models (Schoenberger and Frahm 2016): ``cameras.txt`` and ``images.txt``, or the same in ``.bin``.

COLMAP stores world-to-camera poses, quaternion ``wxyz`` first, in cameras with x right and y down, as here.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import matrix_from_quat_wxyz, rigid_motions
from conformodal.geometry.lens import AnyCamera
from conformodal.io.cameras import UNDISTORT, Size, camera_of, fisheye_of
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import DOUBTFUL, Damaged, FrameTable
from conformodal.io.pose_files import length_doubt, pose_faults, table_of
from conformodal.io.reading import Note, by_name, file_named, image_files, natural_key, times_by_folder

from .colmap_files import ColmapCamera, ColmapModel, model_suffixes, read_model

# Parameters of the camera models that are read, by COLMAP's names.
_LENSES = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}


def model_folders(folder: Path) -> list[Path]:
    """Where in a folder models lie: COLMAP writes one for every part that it could not join, ``sparse/1`` and so on."""
    parts = sorted((folder / "sparse").glob("*"), key=lambda place: natural_key(place.name))
    return [place for place in (folder, folder / "sparse", *parts, folder / "text") if model_suffixes(place)]


def read_colmap(folder: Path) -> FrameTable:
    """Read the images of a model, in the natural order of their names.

    The folder has ``images`` (or the images themselves) and the model in it, in ``sparse``, ``sparse/0`` or ``text``;
    or it is the model's own, with ``images`` above it. Of several models the one of most images is read. Images in
    ``images`` that the model does not name are frames without a pose; folders in it are recordings. Times are those of
    ``times.txt`` (seconds, one per line), or else even (``frame-rate.txt`` in Hz, or 30). The scale is the model's own.
    Images of fisheye lenses and of other cameras than most have are brought to that, once.
    """
    notes: list[Note] = []
    models = [read_model(place) for place in model_folders(folder)]
    if not models:
        raise DatasetError(f"{folder}: holds no COLMAP model; expected cameras.txt and images.txt, or the same in .bin")
    model = max(models, key=lambda model: len(model.images))
    if others := [f"{m.path.parent} ({len(m.images)} images)" for m in models if m is not model]:
        where = f"{model.path.parent} ({len(model.images)} images) is read, not {', '.join(others)}"
        notes.append(Note("other models are not read", where))
    base = _image_folder(folder, model)
    paths = {name: file_named(base, name) for name in model.images}
    unnamed = [] if base == folder else _unnamed(base, list(paths.values()))
    paths |= {name: file_named(base, name) for name in unnamed}
    names = by_name(paths, str)
    usual = Counter(image.camera for image in model.images.values()).most_common(1)[0][0]
    cameras = [model.images[name].camera if name in model.images else usual for name in names]
    images = [paths[name] for name in names]
    lenses: dict[ColmapCamera, AnyCamera] = {}
    for camera in dict.fromkeys(cameras):
        size = common_size([image for image, of in zip(images, cameras, strict=True) if of == camera])
        lenses[camera] = _lens(camera, size, notes)
    poses, why = _poses(model, names, notes)
    times, recording = times_by_folder(folder, images)
    table = FrameTable(
        folder.name, images, times, [lenses[camera] for camera in cameras], poses, recording, why=why, notes=notes
    )
    table.root, table.source, table.as_stored = folder if base.is_relative_to(folder) else base, model.path, True
    return table


def _image_folder(folder: Path, model: ColmapModel) -> Path:
    """The folder that a model's names start from: ``images`` in or above the given one, or that one itself."""
    for base in (*(above / "images" for above in (folder, *folder.parents[:3])), folder):
        if any((base / name.replace("\\", "/")).is_file() for name in model.images):
            return base
    raise DatasetError(
        f"{model.path}: names {next(iter(model.images))}, expected it in {folder / 'images'}; link it there"
    )


def _unnamed(base: Path, named: list[Path]) -> list[str]:
    """Images beside those that the model names, in the same folders: COLMAP has no pose for them."""
    with_pose = {os.path.splitext(os.path.realpath(path))[0] for path in named}
    places = {base, *(path.parent for path in named if path.parent.is_relative_to(base) and path.parent.is_dir())}
    resolved = {os.path.realpath(place): place for place in sorted(places, reverse=True)}.values()
    beside = [path for place in resolved for path in image_files(place)]
    return [
        str(path.relative_to(base)) for path in beside if os.path.splitext(os.path.realpath(path))[0] not in with_pose
    ]


def _poses(model: ColmapModel, names: list[str], notes: list[Note]) -> tuple[FloatArray, Damaged]:
    """Camera to world (n, 7), NaN where there is none, and why."""
    images = [model.images.get(name) for name in names]
    quats = np.array([[np.nan] * 4 if image is None else image.quat_wxyz for image in images])
    shifts = np.array([[np.nan] * 3 if image is None else image.shift_xyz for image in images])
    if doubt := length_doubt(model.path, np.column_stack((quats, shifts)), 0):
        notes.append(Note(DOUBTFUL, doubt))
    faults = pose_faults(shifts, quats)
    sound = np.isfinite(np.column_stack((quats, shifts))).all(axis=1)
    sound[list(faults)] = False
    rotations = matrix_from_quat_wxyz(quats[sound])
    poses = np.full((len(names), 4, 4), np.nan)
    poses[sound] = rigid_motions(rotations.transpose(0, 2, 1), -np.einsum("nji,nj->ni", rotations, shifts[sound]))
    why: Damaged = {}
    for i in np.flatnonzero(~sound).tolist():
        reason = "does not name it" if images[i] is None else "its pose holds NaN or infinity"
        why[i] = f"{model.path}: {faults.get(i, reason)}"
    return table_of(poses), why


def _lens(camera: ColmapCamera, size: Size, notes: list[Note]) -> AnyCamera:
    if camera.model not in _LENSES:
        raise DatasetError(
            f"{camera.where}: camera model {camera.model[:40]} is none of {', '.join(_LENSES)}: {UNDISTORT}"
        )
    names = _LENSES[camera.model].split()
    if len(camera.parameters) != len(names):
        raise DatasetError(f"{camera.where}: {camera.model} has {len(names)} parameters, got {len(camera.parameters)}")
    value = dict(zip(names, camera.parameters, strict=True))
    pixels = tuple(value[name] for name in ("f" if "f" in value else "fx", "f" if "f" in value else "fy", "cx", "cy"))
    if camera.model.endswith("FISHEYE"):
        coefficients = tuple(value.get(name, 0.0) for name in ("k1", "k2", "k3", "k4"))
        return fisheye_of(camera.where, pixels, size, coefficients, stated=camera.size, notes=notes)
    if any(value.get(name) for name in ("k4", "k5", "k6")):
        raise DatasetError(f"{camera.where}: {camera.model} has k4, k5 or k6, expected zeros: {UNDISTORT}")
    lens_names = ("k1", "k2", "p1", "p2", "k3")[: 5 if "k3" in value else 4]
    distortion = tuple(value.get(name, 0.0) for name in lens_names) if "k1" in value else ()
    return camera_of(camera.where, pixels, size, distortion, stated=camera.size, notes=notes)
