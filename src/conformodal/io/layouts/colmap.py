"""COLMAP models (Schoenberger and Frahm 2016): ``cameras.txt`` and ``images.txt``, or the same in ``.bin``.

COLMAP stores world-to-camera poses, quaternion ``wxyz`` first, in cameras with x right and y down, as here.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import matrix_from_quat_wxyz, rigid_motions
from conformodal.io.cameras import UNDISTORT, Size, camera_of
from conformodal.io.decoding import common_size, natural_key
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import DOUBTFUL, Damaged, FrameTable
from conformodal.io.lenses import AnyCamera, as_stored, fisheye_of
from conformodal.io.pose_text import length_doubt, number, pose_faults, table_of, whole_number
from conformodal.io.reading import Note, PathGuard, by_name, image_files, read_lines, reader, times_by_folder
from conformodal.io.recording import Recording

from .colmap_binary import N_PARAMETERS, binary_cameras, binary_images

_Rows = dict[str, tuple[list[float], list[float], int]]  # quaternion, translation and camera by image name

TWICE = "the model is there twice"
_LEVELS = 3
_MANY = 10  # cameras, whose notes are told once
# model: (numbers of fx, fy, cx, cy among the parameters; numbers of k1, k2, p1, p2 and perhaps k3, or of a fisheye
# lens's k1 to k4, None where the lens has none)
_MODELS: dict[str, tuple[tuple[int, int, int, int], tuple[int | None, ...]]] = {
    "SIMPLE_PINHOLE": ((0, 0, 1, 2), ()),
    "PINHOLE": ((0, 1, 2, 3), ()),
    "SIMPLE_RADIAL": ((0, 0, 1, 2), (3, None, None, None)),
    "RADIAL": ((0, 0, 1, 2), (3, 4, None, None)),
    "OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "FULL_OPENCV": ((0, 1, 2, 3), (4, 5, 6, 7, 8)),
    "OPENCV_FISHEYE": ((0, 1, 2, 3), (4, 5, 6, 7)),
    "SIMPLE_RADIAL_FISHEYE": ((0, 0, 1, 2), (3, None, None, None)),
    "RADIAL_FISHEYE": ((0, 0, 1, 2), (3, 4, None, None)),
}
# A line of points holds numbers alone, and an image's name has a letter that no number has.
_POINTS = re.compile(r"[0-9eE+\-. \tnaifNAIF]*")


def model_folders(folder: Path) -> list[Path]:
    """Where in a folder models lie: COLMAP writes one for every part that it could not join, ``sparse/1`` and so on."""
    parts = sorted((folder / "sparse").glob("*"), key=lambda place: natural_key(place.name))
    return [place for place in (folder, folder / "sparse", *parts, folder / "text") if _endings(place)]


def _endings(place: Path) -> list[str]:
    """``bin`` and ``txt``, of a folder that holds a model; COLMAP reads the first where there are both."""
    return [e for e in ("bin", "txt") if all((place / f"{n}.{e}").is_file() for n in ("images", "cameras"))]


@reader
def read_colmap(folder: Path | str, *, require_poses: bool = True, follow_outside: bool = False) -> Recording:
    """Read the images of a model, in the natural order of their names, without decoding them.

    Parameters
    ----------
    folder
        With ``images`` (or the images themselves) and the model in it, in ``sparse``, ``sparse/0`` or ``text``; or the
        model's own folder, with ``images`` above it. Of several models the one of most images is read. Images
        in ``images`` that the model does not name are frames without a pose; folders in it are recordings. Times are
        those of ``times.txt`` (seconds, one a line), or else even (``frame-rate.txt`` in Hz, or 30). The scale is the
        model's own: metres only if the
        model was scaled. Images of fisheye lenses and of other cameras than most have are brought to that, once.
    require_poses
        True leaves out images that are missing, or have no pose or one that is no rigid motion. False keeps them.
    follow_outside
        Whether the model may name images outside the folder.
    """
    folder = Path(folder).resolve()
    notes: list[Note] = []
    models = [(place, *_model(place)) for place in model_folders(folder)]
    if not models:
        raise DatasetError(
            f"{folder}: holds no cameras.txt with images.txt, nor cameras.bin with images.bin; expected a COLMAP model"
        )
    place, of_images, rows, of_cameras, cameras = max(models, key=lambda model: len(model[2]))
    if others := [f"{at} ({len(images)} images)" for at, _, images, *_ in models if at != place]:
        notes.append(
            Note("other models are not read", f"{place} ({len(rows)} images) is read, not {', '.join(others)}")
        )
    if missing := sorted({camera for _, _, camera in rows.values()} - cameras.keys()):
        raise DatasetError(
            f"{of_images}: uses cameras {missing}, expected some of {sorted(cameras)} ({of_cameras.name})"
        )
    if len(_endings(place)) > 1:
        notes.append(Note(TWICE, f"{place}: the binary model is read, as COLMAP does, and not the text"))
    base = _base(folder, of_images, list(rows))
    image = PathGuard(folder if base.is_relative_to(folder) else base, of_images, follow_outside=follow_outside)
    registered = {name: image(base, name) for name in rows}
    unregistered = [] if base == folder else _unregistered(base, list(registered.values()))
    found = registered | {name: image(base, name) for name in unregistered}
    names = by_name(found, str, notes)
    usual = Counter(camera for *_, camera in rows.values()).most_common(1)[0][0]
    wide = [_wide(cameras[rows[name][2] if name in rows else usual]) for name in names]
    images = as_stored([found[name] for name in names], wide, "COLMAP", notes)
    stored = dict(zip(names, images, strict=True))
    poses, why = _poses(of_images, names, rows, notes)
    lenses = _lenses(
        of_cameras, cameras, {name: (stored[name], rows[name][2]) for name in names if name in rows}, notes
    )
    most = Counter(lenses.values()).most_common(1)[0][0]  # images that the model does not name are taken for its
    times, recording = times_by_folder(folder, [found[name] for name in names])
    table = FrameTable(folder.name, images, times, recording, poses, why, notes)
    return table.sequence([lenses.get(name, most) for name in names], require_poses=require_poses)


def _base(folder: Path, of_images: Path, names: list[str]) -> Path:
    """The folder that a model's names start from: ``images`` beside or above it, or another that has them."""
    # a model's own folder, as sparse/0, lies below that of the images
    above = [folder, *folder.parents[:_LEVELS]]
    usual = [base / "images" for base in above if (base / "images").is_dir()]
    others = sorted(path for path in folder.iterdir() if path.is_dir())
    for base in (*usual, folder, *others, *above):
        if any(os.path.isfile(base / name.replace("\\", "/")) for name in names):
            return base
    if usual:  # which names each image that is missing
        return usual[0]
    raise DatasetError(f"{of_images}: names {names[0]}, expected it in {folder / 'images'}, or in another folder there")


def _model(place: Path) -> tuple[Path, _Rows, Path, dict[int, tuple[str, list[str]]]]:
    """Files and contents of a model."""
    ending = _endings(place)[0]
    of_images, of_cameras = place / f"images.{ending}", place / f"cameras.{ending}"
    if ending == "txt":
        return of_images, _images(of_images), of_cameras, _lines_of_cameras(of_cameras)
    return of_images, binary_images(of_images), of_cameras, binary_cameras(of_cameras)


def _lenses(
    path: Path, cameras: dict[int, tuple[str, list[str]]], images: dict[str, tuple[Path, int]], notes: list[Note]
) -> dict[str, AnyCamera]:
    """The camera of every image by name; the same numbers are one camera, whatever their places in the file."""
    made: dict[int, AnyCamera] = {}
    for camera_id in sorted({camera for _, camera in images.values()}):
        size = common_size([image for image, camera in images.values() if camera == camera_id])
        found: list[Note] = []
        made[camera_id] = _camera(path, *cameras[camera_id], size, found)
        notes += [note for note in found if note.what not in {other.what for other in notes} or len(cameras) < _MANY]
    return {name: made[camera] for name, (_, camera) in images.items()}


def _wide(camera: tuple[str, list[str]]) -> bool:
    """Whether a camera's images are wider than high; what is no number is told elsewhere."""
    with suppress(ValueError, IndexError):
        return whole_number(camera[1][2]) > whole_number(camera[1][3])
    return True


def _unregistered(base: Path, registered: list[Path]) -> list[str]:
    """Names of the images beside the registered ones, in the same folders: COLMAP found no pose for them."""
    known = {os.path.splitext(os.path.realpath(path))[0] for path in registered}
    places = {base, *(path.parent for path in registered if path.parent.is_relative_to(base) and path.parent.is_dir())}
    beside = {os.path.realpath(place): place for place in sorted(places, reverse=True)}.values()
    found = [path for place in beside for path in image_files(place)]
    return [str(path.relative_to(base)) for path in found if os.path.splitext(os.path.realpath(path))[0] not in known]


def _poses(path: Path, names: list[str], rows: _Rows, notes: list[Note]) -> tuple[FloatArray, Damaged]:
    """Camera to world (n, 7), NaN where there is none, and why."""
    unknown = [float("nan")] * 4, [float("nan")] * 3, 0
    quats = np.array([rows.get(name, unknown)[0] for name in names])
    shifts = np.array([rows.get(name, unknown)[1] for name in names])
    if doubt := length_doubt(path, np.column_stack((quats, shifts)), 0):
        notes.append(Note(DOUBTFUL, doubt))
    faults = pose_faults(shifts, quats)
    known = np.isfinite(np.column_stack((quats, shifts))).all(axis=1)
    known[list(faults)] = False
    rotations = matrix_from_quat_wxyz(quats[known])
    poses = np.full((len(names), 4, 4), np.nan)
    poses[known] = rigid_motions(rotations.transpose(0, 2, 1), -np.einsum("nji,nj->ni", rotations, shifts[known]))
    why: Damaged = {}
    for i in np.flatnonzero(~known).tolist():
        missing = "its pose holds NaN or infinity" if names[i] in rows else "does not name it"
        why[i] = f"{path}: {faults.get(i, missing)}"
    return table_of(poses), why


def _images(path: Path) -> _Rows:
    """Quaternion, translation and camera by image name.

    A line of points follows every image, which may be empty, or none does.
    """
    found: _Rows = {}
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
            camera = whole_number(line.split()[0])
        except ValueError:
            raise DatasetError(f"{path}, line {at}: is no camera: {line[:80]!r}") from None
        if camera in found:
            raise DatasetError(f"{path}, line {at}: gives camera {camera} a second time, expected each once")
        found[camera] = (f"line {at}", line.split())
    if not found:
        raise DatasetError(f"{path}: holds no camera")
    return found


def _camera(path: Path, at: str, fields: list[str], size: Size, notes: list[Note]) -> AnyCamera:
    line = " ".join(fields)
    try:
        model, width, height = fields[1], whole_number(fields[2]), whole_number(fields[3])
        values = [number(v) for v in fields[4:]]
        places, lens = _MODELS[model]
        if len(values) != N_PARAMETERS[model]:
            raise ValueError(f"{len(values)} parameters")
    except KeyError:
        known = ", ".join(_MODELS)
        raise DatasetError(f"{path}, {at}: camera model {fields[1][:40]} is none of {known}: {UNDISTORT}") from None
    except (ValueError, IndexError) as exc:
        raise DatasetError(f"{path}, {at}: is no camera: {line[:80]!r}: {exc}") from exc
    pixels = tuple(values[i] for i in places)
    distortion = tuple(0.0 if i is None else values[i] for i in lens)
    source, stated = f"{path}, {at}", (width, height)
    if model.endswith("FISHEYE"):
        return fisheye_of(source, pixels, size, distortion, stated=stated, notes=notes)
    if any(values[9:]):
        raise DatasetError(f"{source}: camera model {model} has k4, k5 or k6, expected zeros: {UNDISTORT}")
    return camera_of(source, pixels, size, distortion, stated=stated, notes=notes)
