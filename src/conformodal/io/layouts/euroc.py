"""EuRoC (Burri et al. 2016) and TUM-VI (Schubert et al. 2018): ``mav0/cam0`` with its calibration, the body's poses.

Ground truth is of the body; ``T_BS`` of ``sensor.yaml``, or ``T_cam_imu`` of Kalibr's ``camchain.yaml``, takes it to
the camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from conformodal.core.arrays import FloatArray
from conformodal.geometry.lens import AnyCamera
from conformodal.io.cameras import UNDISTORT, Size, camera_of, fisheye_of
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import FrameTable, paired_by_time
from conformodal.io.pose_files import euroc_table, matrices_of, matrix_faults, table_of
from conformodal.io.reading import MALFORMED, Note, file_named, number, parse_lines, read_lines, whole_number

_MOST_BYTES = 16_000  # a calibration has a tenth of that
_TRUTHS = ("state_groundtruth_estimate0", "mocap0")
_RADIAL, _FISHEYE = ("radial-tangential", "radtan"), "equidistant"
SHIFTED = "times are shifted"


class _Calibration(NamedTuple):
    """A camera, its pose on the body (4, 4), and the seconds by which the body's clock is ahead of its own."""

    camera: AnyCamera
    T_body_cam: FloatArray
    shift_s: float


def looks_like_euroc(folder: Path) -> bool:
    """Whether there is ``cam0/data.csv`` in a folder, or in ``mav0`` in it."""
    return any((place / "cam0" / "data.csv").is_file() for place in (folder, folder / "mav0"))


def read_euroc_mav(folder: Path) -> FrameTable:
    """Read the left camera of ``mav0``, whatever its name, or of the folder that holds it.

    The calibration is ``cam0/sensor.yaml``, or Kalibr's ``camchain.yaml`` in the folder or in ``dso``.
    """
    root = folder if (folder / "cam0").is_dir() else folder / "mav0"
    path, truths = root / "cam0" / "data.csv", [root / name / "data.csv" for name in _TRUTHS]
    notes: list[Note] = []

    def parse(line: str) -> tuple[float, Path]:
        time, name = (field.strip() for field in line.split(",")[:2])
        return whole_number(time) / 1e9, file_named(root / "cam0" / "data", name)

    rows = parse_lines(path, parse, "'timestamp [ns], file'")
    times, images = np.array([time for time, _ in rows]), [image for _, image in rows]
    calibration = _calibration(root, common_size(images), notes)
    table = FrameTable(folder.name, images, times, calibration.camera, notes=notes, root=root, source=truths[0])
    if truth := next((place for place in truths if place.is_file()), None):
        body = paired_by_time(euroc_table, truth, times + calibration.shift_s, notes)
        table.poses = table_of(matrices_of(body.rows) @ calibration.T_body_cam)
        table.why, table.source = body.why, path
    return table


def _calibration(root: Path, size: Size, notes: list[Note]) -> _Calibration:
    sensor = root / "cam0" / "sensor.yaml"
    chains = [place / "camchain.yaml" for place in (root, root.parent, root / "dso", root.parent / "dso")]
    path = next((place for place in (sensor, *chains) if place.is_file()), sensor)
    text = "\n".join(line for line in read_lines(path) if not line.startswith("%YAML"))  # of OpenCV, not valid YAML
    if len(text) > _MOST_BYTES:
        raise DatasetError(f"{path}: has {len(text)} characters, expected a calibration of at most {_MOST_BYTES}")
    kalibr = path is not sensor
    try:
        content: Any = yaml.safe_load(text)
        content = content["cam0"] if kalibr else content
        model, distortion = content.get("camera_model", "pinhole"), content.get("distortion_model", _RADIAL[0])
        pixels = _numbers(content["intrinsics"], 4)
        lens = _numbers(content.get("distortion_coeffs" if kalibr else "distortion_coefficients", []), None)
        width, height = _numbers(content["resolution"], 2)
        (shift_s,) = _numbers([content.get("timeshift_cam_imu", 0.0) if kalibr else 0.0], 1)
        rows = [v for row in content["T_cam_imu"] for v in row] if kalibr else content["T_BS"]["data"]
        T = np.array(_numbers(rows, 16)).reshape(4, 4)
    except (yaml.YAMLError, *MALFORMED) as exc:
        raise DatasetError(f"{path}: is not a camera calibration: {type(exc).__name__}: {str(exc)[:200]}") from exc
    fisheye = distortion == _FISHEYE and len(lens) == 4
    if model != "pinhole" or not (fisheye or distortion in _RADIAL):
        raise DatasetError(
            f"{path}: has camera model {model}, {distortion}; expected pinhole, {_RADIAL[0]} or {_FISHEYE} of four "
            f"numbers: {UNDISTORT}"
        )
    if fault := matrix_faults(T[None]).get(0):
        raise DatasetError(f"{path}: mounting of the camera {fault}")
    if shift_s:
        notes.append(Note(SHIFTED, f"{path}: timeshift_cam_imu, {shift_s:g} s, is added to the images' for poses"))
    make = fisheye_of if fisheye else camera_of
    camera = make(f"{path}: intrinsics", pixels, size, lens, stated=(int(width), int(height)), notes=notes)
    return _Calibration(camera, np.asarray(np.linalg.inv(T) if kalibr else T, dtype=np.float64), shift_s)


def _numbers(values: Any, count: int | None) -> tuple[float, ...]:
    """A list of so many finite numbers; nothing else that YAML may hold."""
    if not isinstance(values, list) or count not in (None, len(values)):
        raise ValueError(f"expected {count or 'a list of'} numbers")
    # YAML 1.1 takes 1e-05, without a point, for text
    numbers = tuple(number(v) if isinstance(v, str) else float(v) for v in values)
    if not np.isfinite(numbers).all():
        raise ValueError(f"expected finite numbers, got {numbers[:9]}")
    return numbers
