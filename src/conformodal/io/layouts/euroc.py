"""EuRoC (Burri et al. 2016): ``mav0/cam0`` with its calibration, and the poses of the body.

``T_BS`` of ``sensor.yaml`` takes the body's poses to the camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from conformodal.core.arrays import FloatArray
from conformodal.geometry import PinholeCamera
from conformodal.io.cameras import Size, camera_of
from conformodal.io.decoding import common_size
from conformodal.io.diagnosis.cameras import UNDISTORT
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import FrameTable
from conformodal.io.pose_files import euroc_table, matrix_faults
from conformodal.io.reading import MALFORMED, Note, file_named, number, parse_lines, read_lines, whole_number

_MAX_BYTES = 16_000  # a calibration has a tenth of that
_LENSES = ("radial-tangential", "radtan")


class _Calibration(NamedTuple):
    camera: PinholeCamera
    T_body_cam: FloatArray  # (4, 4)


def looks_like_euroc(folder: Path) -> bool:
    """Whether there is ``cam0/data.csv`` in a folder, or in ``mav0`` in it."""
    return any((place / "cam0" / "data.csv").is_file() for place in (folder, folder / "mav0"))


def read_euroc_mav(folder: Path) -> FrameTable:
    """Read the left camera of ``mav0``, whatever its name, or of the folder that holds it."""
    root = folder if (folder / "cam0").is_dir() else folder / "mav0"
    path, truth = root / "cam0" / "data.csv", root / "state_groundtruth_estimate0" / "data.csv"
    notes: list[Note] = []

    def parse(line: str) -> tuple[float, Path]:
        time, name = (field.strip() for field in line.split(",")[:2])
        return whole_number(time) / 1e9, file_named(root / "cam0" / "data", name)

    rows = parse_lines(path, parse, "'timestamp [ns], file'")
    times, images = np.array([time for time, _ in rows]), [image for _, image in rows]
    camera, T_body_cam = _calibration(root / "cam0" / "sensor.yaml", common_size(images), notes)
    table = FrameTable(folder.name, images, times, camera, notes=notes, root=root, source=truth)
    if truth.is_file():
        table.add_poses(euroc_table, truth, T_body_cam)
        table.source = path
    return table


def _calibration(path: Path, size: Size, notes: list[Note]) -> _Calibration:
    text = "\n".join(line for line in read_lines(path) if not line.startswith("%YAML"))  # of OpenCV, not valid YAML
    if len(text) > _MAX_BYTES:
        raise DatasetError(f"{path}: has {len(text)} characters, expected a calibration of at most {_MAX_BYTES}")
    try:
        content: Any = yaml.safe_load(text)
        model, distortion = content.get("camera_model", "pinhole"), content.get("distortion_model", _LENSES[0])
        pixels = _numbers(content["intrinsics"], 4)
        lens = _numbers(content.get("distortion_coefficients", []), None)
        width, height = _numbers(content["resolution"], 2)
        T_body_cam = np.array(_numbers(content["T_BS"]["data"], 16)).reshape(4, 4)
    except (yaml.YAMLError, *MALFORMED) as exc:
        raise DatasetError(f"{path}: is not a camera calibration: {type(exc).__name__}: {str(exc)[:200]}") from exc
    if model != "pinhole" or distortion not in _LENSES:
        raise DatasetError(f"{path}: camera is {model}, {distortion}, expected pinhole, {_LENSES[0]}: {UNDISTORT}")
    if fault := matrix_faults(T_body_cam[None]).get(0):
        raise DatasetError(f"{path}: mounting of the camera {fault}")
    stated = int(width), int(height)
    return _Calibration(camera_of(f"{path}: intrinsics", pixels, size, lens, stated=stated, notes=notes), T_body_cam)


def _numbers(values: Any, count: int | None) -> tuple[float, ...]:
    """A list of so many finite numbers; nothing else that YAML may hold."""
    if not isinstance(values, list) or count not in (None, len(values)):
        raise ValueError(f"expected {count or 'a list of'} numbers")
    # YAML 1.1 takes 1e-05, without a point, for text
    numbers = tuple(number(v) if isinstance(v, str) else float(v) for v in values)
    if not np.isfinite(numbers).all():
        raise ValueError(f"expected finite numbers, got {numbers[:9]}")
    return numbers
