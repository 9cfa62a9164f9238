"""All layouts that can be read, and which of them a folder is in.

A layout is a function from a folder to a :class:`FrameTable`, and one that recognises its folders. A package adds its
own by an entry point of the group ``conformodal.layouts`` that names a :class:`Reader`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

from conformodal.core.files import kind_of_file
from conformodal.core.words import as_utf8, counted
from conformodal.geometry import PinholeCamera, PoseError
from conformodal.io.layouts.colmap import model_folders, read_colmap
from conformodal.io.layouts.euroc import looks_like_euroc, read_euroc_mav
from conformodal.io.layouts.images import looks_like_images, read_image_folder
from conformodal.io.layouts.kitti import looks_like_kitti, read_kitti_odometry
from conformodal.io.layouts.nerf import FILES, read_nerf, transforms_file
from conformodal.io.layouts.rgbd_scenes import looks_like_scenes, read_rgbd_scenes
from conformodal.io.layouts.sevenscenes import looks_like_scene, read_sevenscenes
from conformodal.io.layouts.tum import read_tum_rgbd

from .cameras import INTRINSICS
from .errors import DatasetError
from .frame_table import FrameTable
from .reading import image_files
from .recording import Recording

ENTRY_POINTS = "conformodal.layouts"
_MADE = "; a recording becomes one by 'conformodal data convert {} --poses POSES --out FOLDER'"
_MAX_ENTRIES = 200  # that are looked at for a hint
_LAST_RESORT = "images"  # some other layouts have images and intrinsics in one folder too


class Layout(StrEnum):
    """Names of the layouts that come with the package."""

    AUTO = "auto"
    SEVENSCENES = "7scenes"
    RGBD_SCENES = "rgbd-scenes"
    KITTI = "kitti"
    TUM = "tum"
    EUROC = "euroc"
    COLMAP = "colmap"
    NERF = "nerf"
    IMAGES = "images"


class Reader(NamedTuple):
    """How a layout is read."""

    # from a folder to its frames; raises DatasetError, which names a file, for what is missing or damaged
    read: Callable[[Path], FrameTable]
    recognises: Callable[[Path], bool]  # whether a folder is in the layout; looks at names alone
    sign: str  # what gives the layout away, for people


_BUILT_IN: dict[str, Reader] = {
    Layout.SEVENSCENES: Reader(read_sevenscenes, looks_like_scene, "frame-NNNNNN.color.png, in it or in seq-NN"),
    Layout.RGBD_SCENES: Reader(read_rgbd_scenes, looks_like_scenes, "imgs/scene_NN, or FFFFF-color.png"),
    Layout.KITTI: Reader(read_kitti_odometry, looks_like_kitti, "image_0 to image_3, and calib.txt"),
    Layout.TUM: Reader(read_tum_rgbd, lambda folder: (folder / "rgb.txt").is_file(), "rgb.txt"),
    Layout.EUROC: Reader(read_euroc_mav, looks_like_euroc, "mav0/cam0"),
    Layout.COLMAP: Reader(
        read_colmap, lambda folder: bool(model_folders(folder)), "cameras.txt and images.txt, or the same in .bin"
    ),
    Layout.NERF: Reader(read_nerf, lambda folder: transforms_file(folder) is not None, FILES[0]),
    Layout.IMAGES: Reader(read_image_folder, looks_like_images, f"images and {INTRINSICS} or poses"),
}


@cache
def readers() -> dict[str, Reader]:
    """All layouts by name: those of the package, and those that other packages add."""
    layouts = dict(_BUILT_IN)
    for point in entry_points(group=ENTRY_POINTS):
        try:
            reader = point.load()
        except Exception as exc:  # whatever another package does
            raise DatasetError(f"entry point {ENTRY_POINTS}: {point.name} cannot be loaded: {exc}") from exc
        if not isinstance(reader, Reader) or point.name in layouts:
            raise DatasetError(f"entry point {ENTRY_POINTS}: {point.name} is not a Reader, or its name is taken")
        layouts[point.name] = reader
    return layouts


def recognise(folder: Path, *, images_alone: bool = False) -> str:
    """The name of the layout that a folder is in; with `images_alone`, images need no camera or poses beside them."""
    _check_folder(folder)
    try:
        names = [name for name, reader in readers().items() if reader.recognises(folder)]
    except OSError as exc:
        raise DatasetError(as_utf8(f"{folder}: cannot be read: {exc}")) from exc
    if len(names) > 1 and _LAST_RESORT in names:
        names.remove(_LAST_RESORT)
    if len(names) == 1:
        return names[0]
    if images_alone and not names and not (folder / "metadata.yaml").is_file() and image_files(folder):
        return _LAST_RESORT
    what = "is not in a layout that is read. Looked for "
    what += "; ".join(f"{name}: {reader.sign}" for name, reader in readers().items())
    if names:
        what = f"could be {' or '.join(names)}; name its format"
    elif (folder / "metadata.yaml").is_file():
        what = f"looks like a ROS recording, expected a data set{_MADE.format(folder)}"
    elif archives := [path for path in _entries(folder) if kind_of_file(path).startswith("is an archive")]:
        what = f"holds {counted(len(archives), 'archive')}, such as {archives[0].name}; unpack them there"
    elif inside := [path.name for path in _entries(folder) if path.is_dir() and _is_recognised(path)]:
        what = f"is not in a layout that is read, and its folder {inside[0]} is; name that one"
    raise DatasetError(as_utf8(f"{folder}: {what}"))


def _entries(folder: Path) -> list[Path]:
    """The first of what a folder holds."""
    return sorted(folder.iterdir())[:_MAX_ENTRIES]


def _is_recognised(folder: Path) -> bool:
    with suppress(OSError):
        return any(reader.recognises(folder) for name, reader in readers().items() if name != _LAST_RESORT)
    return False


def _check_folder(folder: Path) -> None:
    if not os.path.isdir(folder):
        is_file = os.path.isfile(folder)
        what = f"is a file, expected a data set's folder{_MADE.format(folder)}" if is_file else "no such file or folder"
        if kind := kind_of_file(folder):
            what = f"{kind}; expected a data set's folder"
        raise DatasetError(as_utf8(f"{folder}: {what}"))


def read_recording(
    path: Path | str,
    format: str = Layout.AUTO,
    *,
    require_poses: bool = True,
    focal: float | None = None,
    camera: PinholeCamera | None = None,
) -> Recording:
    """Read a data set, without decoding its images, as in ``examples/images.py``.

    Parameters
    ----------
    path
        Its folder.
    format
        Name of its layout, such as ``"tum"`` (see :func:`readers`); ``"auto"`` recognises it.
    require_poses
        True leaves out frames without a pose or a sound image. False keeps them; the recording has a truth only if
        every frame has a pose.
    focal, camera
        Focal length in pixels, or intrinsics, where nothing says the camera.

    Raises
    ------
    DatasetError
        If the folder is not in the layout, or something in it is missing or damaged.

    Examples
    --------
    ``read_recording("rgbd_dataset_freiburg1_desk")`` reads the images, poses and camera of a TUM sequence.
    """
    if not isinstance(format, str) or format not in (Layout.AUTO, *readers()):
        raise DatasetError(f"format must be one of {', '.join((Layout.AUTO, *readers()))}, got {format!r}")
    if focal is not None and not focal > 0:
        raise DatasetError(f"focal must be a positive number of pixels, got {focal!r}")
    folder = Path(path)
    _check_folder(folder)
    name = recognise(folder, images_alone=camera is not None) if format == Layout.AUTO else format
    try:
        return (
            readers()[name].read(folder.resolve()).to_recording(require_poses=require_poses, focal=focal, camera=camera)
        )
    except (OSError, UnicodeError, PoseError) as exc:
        raise DatasetError(as_utf8(f"{folder}: cannot be read: {exc}")) from exc
