"""All layouts that can be read, and which of them a folder is in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from conformodal.core.ranges import as_member
from conformodal.core.words import counted
from conformodal.io.layouts.colmap import model_folders, read_colmap
from conformodal.io.layouts.euroc import read_euroc_mav
from conformodal.io.layouts.images import POSE_FILES, read_image_folder
from conformodal.io.layouts.kitti import CAMERAS, read_kitti_odometry
from conformodal.io.layouts.nerf import FILE, read_nerf, transforms_file
from conformodal.io.layouts.rgbd_scenes import looks_like_scenes, read_rgbd_scenes
from conformodal.io.layouts.sevenscenes import looks_like_scene, read_sevenscenes
from conformodal.io.layouts.tum import read_tum_rgbd

from .convention import with_fitted_focal
from .errors import DatasetError
from .reading import SUFFIXES, image_files, readable, shown
from .recording import Recording


class Layout(StrEnum):
    """Names of the layouts."""

    AUTO = "auto"
    SEVENSCENES = "7scenes"
    RGBD_SCENES = "rgbd-scenes"
    KITTI = "kitti"
    TUM = "tum"
    EUROC = "euroc"
    COLMAP = "colmap"
    NERF = "nerf"
    IMAGES = "images"


class _Reader(NamedTuple):
    read: Callable[..., Recording]
    sign: str  # what gives the layout away, for people
    fits: Callable[[Path], bool]


def _is_image_folder(folder: Path) -> bool:
    """Images that no other layout claims: some of those have images and intrinsics in one folder too."""
    claimed = any(reader.fits(folder) for layout, reader in _READERS.items() if layout is not Layout.IMAGES)
    known = any((folder / name).is_file() for name in ("camera-intrinsics.txt", *POSE_FILES))
    return not claimed and known and bool(image_files(folder))


_READERS = {
    Layout.SEVENSCENES: _Reader(
        read_sevenscenes, "frame-NNNNNN.color.png or .jpg, in it or in folders seq-NN", looks_like_scene
    ),
    Layout.RGBD_SCENES: _Reader(read_rgbd_scenes, "imgs/scene_NN, or FFFFF-color.png", looks_like_scenes),
    Layout.KITTI: _Reader(
        read_kitti_odometry,
        "image_0 to image_3, and calib.txt",
        lambda f: (f / "calib.txt").is_file() and any((f / name).is_dir() for name in CAMERAS),
    ),
    Layout.TUM: _Reader(read_tum_rgbd, "rgb.txt", lambda f: (f / "rgb.txt").is_file()),
    Layout.EUROC: _Reader(
        read_euroc_mav, "mav0/cam0", lambda f: any((place / "cam0" / "data.csv").is_file() for place in (f, f / "mav0"))
    ),
    Layout.COLMAP: _Reader(
        read_colmap, "cameras.txt and images.txt, or the same in .bin", lambda f: bool(model_folders(f))
    ),
    Layout.NERF: _Reader(read_nerf, FILE, lambda f: transforms_file(f) is not None),
    Layout.IMAGES: _Reader(read_image_folder, "images and camera-intrinsics.txt or poses", _is_image_folder),
}


_MADE = (
    "; a recording becomes one by 'conformodal data convert {} --poses POSES --out FOLDER', where POSES is a TUM file "
    "or a ROS recording's topic"
)
_WITHOUT_CAMERA, _TO_BE_FITTED = (Layout.IMAGES, Layout.TUM), 0.0
_LISTED = (Layout.TUM, Layout.EUROC, Layout.COLMAP, Layout.NERF)  # these name their images in a file
# Folders of images inside other layouts, which lack something else than a camera.
_INSIDE_LAYOUTS = (*CAMERAS, "images", "rgb", "cam0", "data", "imgs")


def recognise(folder: Path) -> Layout:
    """The layout that a folder is in.

    Raises
    ------
    DatasetError
        If the folder is missing, or in no layout or in several; says what was looked for.
    """
    if not readable(str(folder)):
        raise DatasetError(f"{shown(str(folder))}: its name is not UTF-8; rename it")
    try:
        if folder.is_file():
            raise DatasetError(f"{folder}: is a file, expected a data set's folder{_MADE.format(folder)}")
        if not folder.is_dir():
            raise DatasetError(f"{folder}: no such folder")
        found = [layout for layout, reader in _READERS.items() if reader.fits(folder)]
        if not found and (folder / "metadata.yaml").is_file():
            raise DatasetError(f"{folder}: looks like a ROS recording, expected a data set{_MADE.format(folder)}")
    except OSError as exc:
        raise DatasetError(f"{folder}: cannot be read: {exc}") from exc
    if len(found) == 1:
        return found[0]
    looked = "; ".join(f"{layout}: {reader.sign}" for layout, reader in _READERS.items())
    if found:
        raise DatasetError(f"{folder}: could be {' or '.join(found)}; name its format")
    raise DatasetError(
        f"{folder}: is in no layout that is known{_pictures_without_camera(folder)}. Looked for {looked}"
    )


def _pictures_without_camera(folder: Path) -> str:
    """What a folder of pictures lacks, if it is one or has one in it."""
    with suppress(OSError):
        below = sorted(path for path in folder.iterdir() if path.is_dir())
        if named := [shown(str(place)) for place in below if any(its.fits(place) for its in _READERS.values())]:
            return f": name a folder in it, such as {', '.join(named[:3])}"
        for place in (folder, *below):
            if place.name not in _INSIDE_LAYOUTS and (pictures := image_files(place)):
                where = f"{shown(str(place))} holds {counted(len(pictures), 'picture')}"
                return f": {where}; put camera-intrinsics.txt beside them"
        beside = [name for name in (*POSE_FILES, "camera-intrinsics.txt") if (folder / name).is_file()]
        for place in below:
            if beside and image_files(place):
                return f": put {' and '.join(beside)} into {shown(str(place))}, which holds the images"
        kinds = Counter(path.suffix for path in folder.iterdir() if path.is_file() and path.suffix)
        if kinds:
            kind, n = kinds.most_common(1)[0]
            what = f"name a recording itself, or write images as {', '.join(SUFFIXES)}"
            return f": it holds {counted(n, shown(kind) + ' file')}; {what}"
    return ""


def read_recording(
    folder: Path | str,
    layout: Layout | str = Layout.AUTO,
    *,
    require_poses: bool = True,
    follow_outside: bool = False,
    focal: float | str | None = None,
) -> Recording:
    """Read a data set in a layout, or in the one it is found to be in, as in ``examples/images.py``.

    Parameters
    ----------
    folder
        See the layout's own reader.
    layout
        ``auto`` recognises it.
    require_poses
        False also reads frames without poses.
    follow_outside
        Whether files of the data set may name images outside its folder, by ``..`` or absolute paths.
    focal
        Focal length in pixels of ``images`` and ``tum`` without a camera; ``auto`` fits it to poses and images.

    Raises
    ------
    DatasetError
        If the folder is not in the layout, or something in it is missing or damaged.
    """
    place = Path(folder)
    kind = as_member(layout, Layout, "layout", DatasetError)
    kind = recognise(place) if kind is Layout.AUTO else kind
    reader = _READERS[kind]
    outside = {"follow_outside": follow_outside} if kind in _LISTED else {}
    if focal is None:
        return reader.read(place, require_poses=require_poses, **outside)
    if kind not in _WITHOUT_CAMERA:
        both = " and ".join(_WITHOUT_CAMERA)
        raise DatasetError(f"{place}: {kind} has a camera, and a focal length is for {both}")
    try:
        focal_px = _TO_BE_FITTED if focal == "auto" else float(focal)
    except ValueError:
        focal_px = -1.0
    if focal != "auto" and not focal_px > 0:
        raise DatasetError(f"focal must be a positive number of pixels or auto, got {focal!r}")
    sequence = reader.read(place, require_poses=require_poses or focal == "auto", focal_px=focal_px, **outside)
    return with_fitted_focal(sequence) if focal == "auto" else sequence
