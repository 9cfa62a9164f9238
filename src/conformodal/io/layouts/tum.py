"""TUM RGB-D (Sturm et al. 2012): ``rgb.txt`` lists images by time, ``groundtruth.txt`` poses by theirs."""

from __future__ import annotations

import re
from pathlib import Path

from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import camera_beside
from conformodal.io.decoding import common_size
from conformodal.io.frame_table import Damaged, FrameTable, listed, paired_by_time
from conformodal.io.pose_files import tum_table
from conformodal.io.pose_text import fractions_of, number
from conformodal.io.reading import NUMBERS, Note, PathGuard, reader
from conformodal.io.recording import Recording

# Published calibrations of the three colour cameras; freiburg3's images have no distortion left.
CAMERAS = {
    "1": PinholeCamera(517.3, 516.5, 318.6, 255.3, 640, 480, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": PinholeCamera(520.9, 521.0, 325.1, 249.7, 640, 480, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": PinholeCamera(535.4, 539.2, 320.1, 247.6, 640, 480),
}

_ASSOCIATED = re.compile(r"([\d.eE+-]+)\s+(\S+)\s+([\d.eE+-]+)\s+(\S+)")


@reader
def read_tum_rgbd(
    folder: Path | str, *, require_poses: bool = True, follow_outside: bool = False, focal_px: float | None = None
) -> Recording:
    """Read a sequence, without decoding images.

    Parameters
    ----------
    folder
        With ``rgb.txt`` and ``groundtruth.txt``. The camera is that of freiburg1, 2 or 3 by the folder's name (``fr3``
        will do), unless ``camera-intrinsics.txt`` lies in it.
    require_poses
        True leaves out images without a pose by time. False keeps all of them; the sequence has a truth only
        if every one has a pose.
    follow_outside
        Whether ``rgb.txt`` may name files outside the folder.
    focal_px
        Focal length where the camera is not known; else that which EXIF says.
    """
    folder = Path(folder).resolve()
    path, truth = folder / "rgb.txt", folder / "groundtruth.txt"
    notes: list[Note] = []
    stamps: list[str] = []

    place = PathGuard(folder, path, follow_outside=follow_outside)

    def parse(line: str) -> tuple[float, Path]:
        time, name = re.split(r"[,;\s]", line.strip(), maxsplit=1)
        if not name.strip():
            raise ValueError(line)
        if match := _ASSOCIATED.fullmatch(f"{time} {name.strip()}"):  # of an image and its depth, in either order
            time, name = match.groups()[2:] if "depth" in match[2] else match.groups()[:2]
        image = number(time), place(folder, name.strip())
        stamps.append(time)
        return image

    images, times = listed(path, parse, "'timestamp filename'", notes)
    if (numbers := fractions_of(stamps, in_order=True)) is not None and (times >= 0).all():
        times, told = numbers
        notes += [Note(NUMBERS, f"{path}: {told}")] if told else []
    match = re.search(r"(?<![A-Za-z])(?:freiburg|fr)([123])(?![0-9])", folder.name)
    default = CAMERAS[match[1]] if match else None
    camera = camera_beside(folder, common_size(images), default, notes, focal_px=focal_px, images=images)
    poses, why = None, Damaged()
    if require_poses or truth.is_file():
        poses, why = paired_by_time(tum_table, truth, times, notes)
    table = FrameTable(folder.name, images, times, poses=poses, why=why, notes=notes)
    return table.sequence(camera, require_poses=require_poses)
