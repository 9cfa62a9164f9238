"""COLMAP models (Schoenberger and Frahm 2016): ``cameras.txt`` and ``images.txt``, or the same in ``.bin``.

COLMAP stores world-to-camera poses, quaternion ``wxyz`` first, in cameras with x right and y down, as here.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from conformodal.poses import PinholeCamera, matrix_from_quat_wxyz
from conformodal.poses.text import number, pose_faults, table_of, whole_number

from .cameras import UNDISTORT, Size, camera_of
from .colmap_binary import binary_cameras, binary_images
from .decoding import common_size, natural_key
from .draft import Draft
from .errors import DatasetError
from .files import Inside, Remark, even_times, read_lines, reader
from .sequence import Sequence

_PLACES = ("", "sparse", "sparse/0", "text")
# model: (numbers of fx, fy, cx, cy among the parameters, numbers of k1, k2, p1, p2 or None where the lens has none)
_MODELS: dict[str, tuple[tuple[int, int, int, int], tuple[int | None, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3, None, None, None)),
    "RADIAL": ((0, 0, 1, 2), (3, 4, None, None)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
}
# A line of points holds numbers alone, and an image's name has a letter that no number has.
_POINTS = re.compile(r"[0-9eE+\-. \tnaifNAIF]*")


def model_folder(folder: Path) -> Path | None:
    """Where in a folder a model lies, if there is one."""
    return next((place for place in (folder / name for name in _PLACES) if _ending(place)), None)


def _ending(place: Path) -> str | None:
    """``txt`` or ``bin``, of a folder that holds a model; the text where there are both."""
    whole = (e for e in ("txt", "bin") if all((place / f"{n}.{e}").is_file() for n in ("images", "cameras")))
    return next(whole, None)


@reader
def read_colmap(folder: Path | str, *, require_poses: bool = True, follow_outside: bool = False) -> Sequence:
    """Read the registered images of a model, in the natural order of their names, without decoding them.

    Parameters
    ----------
    folder
        With ``images`` (or the images themselves) and the model in it, in ``sparse``, ``sparse/0`` or ``text``.
        ``frame-rate.txt`` (Hz) gives the images their times, else 30 a second. The scale is the model's own: metres
        only if the model was scaled.
    require_poses
        True leaves out images that are missing, or whose pose is no rigid motion. False keeps them.
    follow_outside
        Whether the model may name images outside the folder.

    Raises
    ------
    DatasetError
        If there is no model, it holds several cameras or another camera model, or a line is damaged. Names the file.
    """
    folder = Path(folder).resolve()
    place = model_folder(folder)
    if place is None:
        raise DatasetError(
            f"{folder}: holds no cameras.txt with images.txt, nor cameras.bin with images.bin; expected a COLMAP model"
        )
    ending = _ending(place)
    of_images, of_cameras = place / f"images.{ending}", place / f"cameras.{ending}"
    rows = _images(of_images) if ending == "txt" else binary_images(of_images)
    cameras = _lines_of_cameras(of_cameras) if ending == "txt" else binary_cameras(of_cameras)
    used = sorted({camera for _, _, camera in rows.values()})
    if len(used) != 1 or used[0] not in cameras:
        raise DatasetError(f"{of_images}: uses cameras {used}, expected one of {sorted(cameras)}")
    names = sorted(rows, key=natural_key)
    base = folder / "images" if (folder / "images").is_dir() else folder
    image = Inside(folder, of_images, follow_outside=follow_outside)
    images = [image(base, name) for name in names]
    remarks: list[Remark] = []
    camera = _camera(of_cameras, *cameras[used[0]], common_size(images), remarks)
    quats = np.array([rows[name][0] for name in names])
    shifts = np.array([rows[name][1] for name in names])
    faults = pose_faults(shifts, quats)
    known = np.isfinite(np.column_stack((quats, shifts))).all(axis=1)
    known[list(faults)] = False
    rotations = matrix_from_quat_wxyz(quats[known])
    poses = np.full((len(names), 4, 4), np.nan)
    poses[known] = np.eye(4)
    poses[known, :3, :3] = rotations.transpose(0, 2, 1)
    poses[known, :3, 3] = -np.einsum("nji,nj->ni", rotations, shifts[known])
    why = {
        i: f"{of_images}: {faults.get(i, 'its pose holds NaN or infinity')}" for i in np.flatnonzero(~known).tolist()
    }
    times, recording = even_times(folder, len(names)), np.zeros(len(names), dtype=np.int64)
    draft = Draft(folder.name, images, times, recording, table_of(poses), why, remarks)
    return draft.sequence(camera, require_poses=require_poses)


def _images(path: Path) -> dict[str, tuple[list[float], list[float], int]]:
    """Quaternion, translation and camera by image name.

    A line of points follows every image, which may be empty, or none does.
    """
    found: dict[str, tuple[list[float], list[float], int]] = {}
    followed: list[bool] = []
    for at, line in enumerate(read_lines(path), start=1):
        if line.startswith("#"):
            continue
        numbers_alone = _POINTS.fullmatch(line) is not None
        if numbers_alone and followed and not followed[-1] and len(line.split()) % 3 == 0:
            followed[-1] = True
            continue
        if not line.strip():
            continue
        fields = line.split(maxsplit=9)
        try:
            if numbers_alone:
                raise ValueError
            whole_number(fields[0])
            values, camera, name = [number(v) for v in fields[1:8]], whole_number(fields[8]), fields[9].strip()
        except (ValueError, IndexError):
            raise DatasetError(
                f"{path}, line {at}: expected 'id qw qx qy qz tx ty tz camera name', got {line[:80]!r}"
            ) from None
        if name in found:
            raise DatasetError(f"{path}, line {at}: names {name[:80]!r} a second time, expected one pose for an image")
        found[name] = (values[:4], values[4:], camera)
        followed.append(False)
    if not found:
        raise DatasetError(f"{path}: holds no image")
    if len(set(followed[:-1])) > 1:
        name = list(found)[followed.index(False)]
        raise DatasetError(f"{path}: {name!r} has no line of points, and others have; is a line missing?")
    return found


def _lines_of_cameras(path: Path) -> dict[int, tuple[str, list[str]]]:
    """Place in the file and fields by camera."""
    found = {}
    for at, line in enumerate(read_lines(path), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            found[whole_number(line.split()[0])] = (f"line {at}", line.split())
        except ValueError:
            raise DatasetError(f"{path}, line {at}: is no camera: {line[:80]!r}") from None
    if not found:
        raise DatasetError(f"{path}: holds no camera")
    return found


def _camera(path: Path, at: str, fields: list[str], size: Size, remarks: list[Remark]) -> PinholeCamera:
    line = " ".join(fields)
    try:
        model, width, height = fields[1], whole_number(fields[2]), whole_number(fields[3])
        values = [number(v) for v in fields[4:]]
        places, lens = _MODELS[model]
        if len(values) != 1 + max(*places, *(i for i in lens if i is not None)):
            raise ValueError(f"{len(values)} parameters")
        pixels = tuple(values[i] for i in places)
        distortion = tuple(0.0 if i is None else values[i] for i in lens)
    except KeyError:
        known = ", ".join(_MODELS)
        raise DatasetError(f"{path}, {at}: camera model {fields[1][:40]} is none of {known}: {UNDISTORT}") from None
    except (ValueError, IndexError) as exc:
        raise DatasetError(f"{path}, {at}: is no camera: {line[:80]!r}: {exc}") from exc
    return camera_of(f"{path}, {at}", pixels, size, distortion, stated=(width, height), remarks=remarks)
