"""EuRoC (Burri et al. 2016): ``mav0/cam0`` with its calibration, and the body's poses.

Ground truth is of the body; ``T_BS`` of ``sensor.yaml`` takes it to the camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from conformodal.poses import PinholeCamera, Trajectory
from conformodal.poses.formats import euroc_table
from conformodal.poses.text import matrix_faults, table_of, whole_number

from .cameras import UNDISTORT, Size, camera_of
from .decoding import common_size
from .errors import DatasetError
from .frame_table import FrameTable, listed, paired_by_time
from .reading import Note, PathGuard, read_lines, reader
from .sequence import Sequence

# Ground truth comes at 200 Hz.
MAX_TIME_DIFFERENCE_S = 0.005
_MOST_BYTES = 16_000  # a calibration has a tenth of that
_TRUTH = "state_groundtruth_estimate0"


@reader
def read_euroc_mav(folder: Path | str, *, require_poses: bool = True, follow_outside: bool = False) -> Sequence:
    """Read the left camera of a sequence, without decoding images.

    Parameters
    ----------
    folder
        ``mav0``, or the folder that holds it.
    require_poses
        True leaves out images without a pose within 5 ms: ground truth starts later than the camera. False keeps all
        of them; the sequence has a truth only if every one has a pose.
    follow_outside
        Whether ``data.csv`` may name files outside the folder.
    """
    folder = Path(folder).resolve()
    root = folder if folder.name == "mav0" else folder / "mav0"
    path, truth = root / "cam0" / "data.csv", root / _TRUTH / "data.csv"
    data, notes = root / "cam0" / "data", list[Note]()

    place = PathGuard(root, path, follow_outside=follow_outside)

    def parse(line: str) -> tuple[float, Path]:
        time, name = (field.strip() for field in line.split(",")[:2])
        if not name:
            raise ValueError
        return whole_number(time) / 1e9, place(data, name)

    images, times = listed(path, parse, "'timestamp [ns], file'", notes)
    camera, T_body_cam = _sensor(root / "cam0" / "sensor.yaml", common_size(images), notes)
    poses = None
    if require_poses and not truth.is_file():
        raise DatasetError(f"{truth}: poses are missing")
    if truth.is_file():
        poses = paired_by_time(euroc_table, truth, times, MAX_TIME_DIFFERENCE_S, notes)
        known = np.isfinite(poses).all(axis=1)
        body = Trajectory(times[known], poses[known, :3], poses[known, 3:])
        poses[known] = table_of(body.poses_se3 @ T_body_cam)
    why = dict.fromkeys(range(len(images)), f"no pose within {MAX_TIME_DIFFERENCE_S:g} s in {truth}")
    table = FrameTable(folder.name, images, times, poses=poses, why=why, notes=notes)
    return table.sequence(camera, require_poses=require_poses)


def _sensor(path: Path, size: Size, notes: list[Note]) -> tuple[PinholeCamera, npt.NDArray[np.float64]]:
    text = "\n".join(read_lines(path))
    if len(text) > _MOST_BYTES:
        raise DatasetError(f"{path}: has {len(text)} characters, expected a calibration of at most {_MOST_BYTES}")
    try:
        sensor: Any = yaml.safe_load(text)
        pixels = _numbers(sensor["intrinsics"], 4)
        lens = _numbers(sensor.get("distortion_coefficients") or (), None)
        T_body_cam = np.array(_numbers(sensor["T_BS"]["data"], 16)).reshape(4, 4)
        model = (sensor.get("camera_model", "pinhole"), sensor.get("distortion_model", "radial-tangential"))
        stated = _numbers(sensor["resolution"], 2) if "resolution" in sensor else None
    except (
        yaml.YAMLError,
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
        IndexError,
        OverflowError,
        RecursionError,
    ) as exc:
        raise DatasetError(f"{path}: is no EuRoC camera calibration: {type(exc).__name__}: {str(exc)[:200]}") from exc
    if model not in (("pinhole", "radial-tangential"), ("pinhole", "radtan")):
        raise DatasetError(
            f"{path}: has camera model {model[0]}, {model[1]}; expected pinhole, radial-tangential: {UNDISTORT}"
        )
    faults = matrix_faults(T_body_cam[None])
    if faults or not np.isfinite(T_body_cam).all():
        raise DatasetError(f"{path}: T_BS {faults.get(0, 'holds NaN or infinity')}")
    whole = None if stated is None else (int(stated[0]), int(stated[1]))
    lens = lens if any(lens) else ()
    camera = camera_of(f"{path}: intrinsics", pixels, size, lens, stated=whole, notes=notes)
    return camera, T_body_cam


def _numbers(values: Any, count: int | None) -> tuple[float, ...]:
    """A list of so many finite numbers; nothing else that YAML may hold."""
    numbers = tuple(float(v) for v in values if isinstance(v, (int, float)) and not isinstance(v, bool))
    if len(numbers) != len(values) or count not in (None, len(numbers)) or not np.isfinite(numbers).all():
        raise ValueError(f"expected {count or 'a list of'} numbers")
    return numbers
