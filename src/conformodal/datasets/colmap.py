"""COLMAP text models (Schoenberger and Frahm 2016): ``cameras.txt`` and ``images.txt``.

COLMAP stores world-to-camera poses, quaternion ``wxyz`` first, in cameras with x right and y down, as here.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from conformodal.poses import PinholeCamera, PoseError, Trajectory, matrix_from_quat_wxyz

from .errors import DatasetError
from .files import even_times, read_lines
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


def model_folder(folder: Path) -> Path | None:
    """Where in a folder a text model lies, if there is one."""
    places = (folder / place for place in _PLACES)
    return next((p for p in places if (p / "images.txt").is_file() and (p / "cameras.txt").is_file()), None)


def read_colmap(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read the registered images of a text model, in the order of their names, without decoding them.

    Parameters
    ----------
    folder
        With ``images`` (or the images themselves) and the model in it, in ``sparse``, ``sparse/0`` or ``text``.
        ``frame-rate.txt`` (Hz) gives the images their times, else 30 a second. The scale is the model's own: metres
        only if the model was scaled.
    require_poses
        Every registered image has a pose, so it makes no difference.

    Raises
    ------
    DatasetError
        If there is no model, it holds several cameras or another camera model, or a line is damaged. Names the file.
    """
    folder = Path(folder).resolve()
    place = model_folder(folder)
    if place is None:
        raise DatasetError(f"{folder}: holds no cameras.txt with images.txt; expected a COLMAP text model")
    rows = _images(place / "images.txt")
    cameras = _cameras(place / "cameras.txt")
    used = sorted({camera for _, _, camera in rows.values()})
    if len(used) != 1 or used[0] not in cameras:
        raise DatasetError(f"{place / 'images.txt'}: uses cameras {used}, expected one of {sorted(cameras)}")
    names = sorted(rows)
    images = folder / "images" if (folder / "images").is_dir() else folder
    quats = np.array([rows[name][0] for name in names])
    shifts = np.array([rows[name][1] for name in names])
    rotations = matrix_from_quat_wxyz(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, :3, :3] = rotations.transpose(0, 2, 1)
    poses[:, :3, 3] = -np.einsum("nji,nj->ni", rotations, shifts)
    times = even_times(folder, len(names))
    recording = np.zeros(len(names), dtype=np.int64)
    truth = Trajectory.from_poses_se3(times, poses)
    return Sequence(folder.name, tuple(images / name for name in names), times, recording, cameras[used[0]], truth)


def _images(path: Path) -> dict[str, tuple[list[float], list[float], int]]:
    """Quaternion, translation and camera by image name; every second line holds points and is skipped."""
    found: dict[str, tuple[list[float], list[float], int]] = {}
    lines = [(n, line) for n, line in enumerate(read_lines(path), start=1) if not line.startswith("#")]
    for number, line in lines[::2]:
        if not line.strip():
            continue
        fields = line.split(maxsplit=9)
        try:
            values = [float(v) for v in fields[1:8]]
            if not np.isfinite(values).all() or not np.linalg.norm(values[:4]) > 0:
                raise ValueError
            found[fields[9]] = (values[:4], values[4:], int(fields[8]))
        except (ValueError, IndexError):
            raise DatasetError(
                f"{path}, line {number}: expected 'id qw qx qy qz tx ty tz camera name', got {line[:80]!r}"
            ) from None
    if not found:
        raise DatasetError(f"{path}: holds no image")
    return found


def _cameras(path: Path) -> dict[int, PinholeCamera]:
    found = {}
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = line.split()
        try:
            model, width, height = fields[1], int(fields[2]), int(fields[3])
            values = [float(v) for v in fields[4:]]
            places, lens = _MODELS[model]
            fx, fy, cx, cy = (values[i] for i in places)
            distortion = tuple(0.0 if i is None else values[i] for i in lens)
            found[int(fields[0])] = PinholeCamera(fx, fy, cx, cy, width, height, distortion)
        except KeyError:
            known = ", ".join(_MODELS)
            raise DatasetError(f"{path}, line {number}: camera model {fields[1]} is none of {known}") from None
        except (ValueError, IndexError, PoseError) as exc:
            raise DatasetError(f"{path}, line {number}: is no camera: {line[:80]!r}: {exc}") from exc
    return found
