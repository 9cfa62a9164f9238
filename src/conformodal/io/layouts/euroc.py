"""EuRoC (Burri et al. 2016) and TUM-VI (Schubert et al. 2018): ``mav0/cam0`` with its calibration, the body's poses.

Ground truth is of the body; ``T_BS`` of ``sensor.yaml``, or ``T_cam_imu`` of Kalibr's ``camchain.yaml``, takes it to
the camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory
from conformodal.io.cameras import UNDISTORT, Size, camera_beside, camera_of
from conformodal.io.decoding import common_size
from conformodal.io.errors import DatasetError
from conformodal.io.frame_table import Damaged, FrameTable, listed, paired_by_time
from conformodal.io.lenses import AnyCamera, fisheye_of
from conformodal.io.pose_files import euroc_table
from conformodal.io.pose_text import matrix_faults, nanoseconds, number, table_of
from conformodal.io.reading import MALFORMED, Note, PathGuard, read_lines, reader
from conformodal.io.recording import Recording

_BESIDE = "camera-intrinsics.txt"
_MOST_BYTES = 16_000  # a calibration has a tenth of that
_TRUTHS = ("state_groundtruth_estimate0", "mocap0")
_RADIAL, _FISHEYE, _NO_LENS = ("radial-tangential", "radtan"), "equidistant", "none"
_NO_MOUNTING, SHIFTED = "no mounting of the camera", "times are shifted"


@reader
def read_euroc_mav(folder: Path | str, *, require_poses: bool = True, follow_outside: bool = False) -> Recording:
    """Read the left camera of a sequence, without decoding images.

    Parameters
    ----------
    folder
        ``mav0``, whatever its name, or the folder that holds it. The calibration is ``cam0/sensor.yaml``, Kalibr's
        ``camchain.yaml`` (in the folder or in ``dso``), or ``camera-intrinsics.txt``. One without a mounting leaves
        the body's poses as the camera's.
    require_poses
        True leaves out images without a pose by time: ground truth starts later than the camera. False keeps all
        of them; the sequence has a truth only if every one has a pose.
    follow_outside
        Whether ``data.csv`` may name files outside the folder.
    """
    folder = Path(folder).resolve()
    root = folder if folder.name == "mav0" or (folder / "cam0").is_dir() else folder / "mav0"
    path, truths = root / "cam0" / "data.csv", [root / name / "data.csv" for name in _TRUTHS]
    truth = next((place for place in truths if place.is_file()), truths[0])
    data, notes = root / "cam0" / "data", list[Note]()

    place = PathGuard(root, path, follow_outside=follow_outside)

    def parse(line: str) -> tuple[float, Path]:
        time, name = (field.strip() for field in line.split(",")[:2])
        if not name:
            raise ValueError
        return nanoseconds(time) / 1e9, place(data, name)

    images, times = listed(path, parse, "'timestamp [ns], file'", notes)
    camera, T_body_cam, shift_s = _calibration(root, common_size(images), notes)
    poses, why = None, Damaged()
    if require_poses and not truth.is_file():
        raise DatasetError(f"{truth}: poses are missing")
    if truth.is_file():
        poses, why = paired_by_time(euroc_table, truth, times + shift_s, notes)
        known = np.isfinite(poses).all(axis=1)
        body = Trajectory(times[known], poses[known, :3], poses[known, 3:])
        poses[known] = table_of(body.poses_se3 @ T_body_cam)
    table = FrameTable(folder.name, images, times, poses=poses, why=why, notes=notes)
    return table.sequence(camera, require_poses=require_poses)


def _calibration(root: Path, size: Size, notes: list[Note]) -> tuple[AnyCamera, FloatArray, float]:
    """The camera, its pose on the body (4, 4), and the seconds by which the body's clock is ahead of its own."""
    sensor = root / "cam0" / "sensor.yaml"
    places = (root / "cam0", root, root.parent, root / "dso", root.parent / "dso")
    chains = [path for place in places for path in sorted(place.glob("*chain*.y*ml"))]
    path = next((place for place in (sensor, *chains) if place.is_file()), sensor)
    beside = next((place for place in (root / "cam0", root, root.parent) if (place / _BESIDE).is_file()), None)
    if not path.is_file() and beside is not None:
        notes.append(Note(_NO_MOUNTING, f"{sensor}: is missing, so the body's poses are taken as the camera's"))
        return camera_beside(beside, size, None, notes), np.eye(4), 0.0
    lines = read_lines(path)
    text = "\n".join(lines[1:] if lines and lines[0].startswith("%YAML") else lines).replace("!!opencv-matrix", "")
    if len(text) > _MOST_BYTES:
        raise DatasetError(f"{path}: has {len(text)} characters, expected a calibration of at most {_MOST_BYTES}")
    try:
        content: Any = yaml.safe_load(text)
        kalibr = path is not sensor
        content = content["cam0"] if kalibr else content
        if (kind := content.get("camera_model", "pinhole")) != "pinhole":
            raise DatasetError(f"{path}: has camera model {kind}, expected pinhole: {UNDISTORT}")
        pixels = _numbers(content["intrinsics"], 4)
        lens = _numbers(content.get("distortion_coeffs" if kalibr else "distortion_coefficients") or (), None)
        name, shift_s = "T_cam_imu" if kalibr else "T_BS", 0.0
        if name not in content:  # a calibration of cameras alone
            notes.append(Note(_NO_MOUNTING, f"{path}: has no {name}, so the body's poses are taken as the camera's"))
        found = content.get(name, {"data": np.eye(4).ravel().tolist()})
        rows = found["data"] if isinstance(found, dict) else found
        rows = [v for row in rows for v in row] if isinstance(rows[0], list) else rows
        mounting = np.array(_numbers(rows, 16)).reshape(4, 4)
        model = content.get("distortion_model") or _RADIAL[0]
        if kalibr and content.get("timeshift_cam_imu"):
            (shift_s,) = _numbers([content["timeshift_cam_imu"]], 1)
            notes.append(Note(SHIFTED, f"{path}: timeshift_cam_imu, {shift_s:g} s, is added to the images' for poses"))
        stated = _numbers(content["resolution"], 2) if "resolution" in content else None
    except DatasetError:
        raise
    except (yaml.YAMLError, *MALFORMED) as exc:
        raise DatasetError(f"{path}: is no EuRoC camera calibration: {type(exc).__name__}: {str(exc)[:200]}") from exc
    known = model in (*_RADIAL, _FISHEYE) or (model == _NO_LENS and not any(lens))
    if not known or (model == _FISHEYE and len(lens) != 4):
        raise DatasetError(
            f"{path}: has camera model pinhole, {model}; expected pinhole, {_RADIAL[0]} or {_FISHEYE} of four "
            f"numbers: {UNDISTORT}"
        )
    faults = matrix_faults(mounting[None])
    if faults:
        raise DatasetError(f"{path}: {name} {faults[0]}")
    whole = None if stated is None else (int(stated[0]), int(stated[1]))
    source = f"{path}: intrinsics"
    if model == _FISHEYE:
        camera: AnyCamera = fisheye_of(source, pixels, size, lens, stated=whole, notes=notes)
    else:
        camera = camera_of(source, pixels, size, lens if any(lens) else (), stated=whole, notes=notes)
    return camera, np.linalg.inv(mounting) if kalibr else mounting, shift_s


def _numbers(values: Any, count: int | None) -> tuple[float, ...]:
    """A list of so many finite numbers; nothing else that YAML may hold."""
    read = [number(v) if isinstance(v, str) else v for v in values]  # YAML 1.1 takes 1e-05, without a point, for text
    numbers = tuple(float(v) for v in read if isinstance(v, (int, float)) and not isinstance(v, bool))
    fits = count in (None, len(numbers)) and len(numbers) == len(values) and not isinstance(values, str)
    if not fits or not np.isfinite(numbers).all():
        raise ValueError(f"expected {count or 'a list of'} numbers")
    return numbers
