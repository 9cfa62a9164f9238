"""EuRoC (Burri et al. 2016): ``mav0/cam0`` with its calibration, and the body's poses.

Ground truth is of the body; ``T_BS`` of ``sensor.yaml`` takes it to the camera.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from conformodal.poses import PinholeCamera, PoseError, Trajectory, TrajectoryFileError, read_euroc

from .errors import DatasetError
from .files import image_size, poses_at, read_lines
from .sequence import Sequence

# Ground truth comes at 200 Hz.
MAX_TIME_DIFFERENCE_S = 0.005
_TRUTH = "state_groundtruth_estimate0"


def read_euroc_mav(folder: Path | str, *, require_poses: bool = True) -> Sequence:
    """Read the left camera of a sequence, without decoding images.

    Parameters
    ----------
    folder
        ``mav0``, or the folder that holds it.
    require_poses
        True leaves out images without a pose within 5 ms: ground truth starts later than the camera. False keeps all
        of them; the sequence has a truth only if every one has a pose.

    Raises
    ------
    DatasetError
        If something is missing or damaged, or the camera model is another. Names the file.
    """
    folder = Path(folder).resolve()
    root = folder if folder.name == "mav0" else folder / "mav0"
    listed = root / "cam0" / "data.csv"
    stamps, images = [], []
    for number, line in enumerate(read_lines(listed), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        fields = [field.strip() for field in line.split(",")]
        try:
            stamps.append(int(fields[0]) / 1e9)
            images.append(root / "cam0" / "data" / fields[1])
        except (ValueError, IndexError):
            raise DatasetError(f"{listed}, line {number}: expected 'timestamp [ns], file', got {line[:80]!r}") from None
    if not images:
        raise DatasetError(f"{listed}: lists no image")
    times = np.array(stamps)
    camera, T_body_cam = _sensor(root / "cam0" / "sensor.yaml", image_size(images[0]))
    truth = None
    path = root / _TRUTH / "data.csv"
    if require_poses and not path.is_file():
        raise DatasetError(f"{path}: poses are missing")
    if path.is_file():
        try:
            body = read_euroc(path)
        except TrajectoryFileError as exc:
            raise DatasetError(str(exc)) from exc
        frames, body = poses_at(body, times, MAX_TIME_DIFFERENCE_S, path)
        truth = Trajectory.from_poses_se3(body.timestamps_s, body.poses_se3 @ T_body_cam)
        if require_poses:
            images, times = [images[i] for i in frames], times[frames]
        elif len(frames) < len(images):
            truth = None
    return Sequence(folder.name, tuple(images), times, np.zeros(len(images), dtype=np.int64), camera, truth)


def _sensor(path: Path, size: tuple[int, int]) -> tuple[PinholeCamera, npt.NDArray[np.float64]]:
    try:
        sensor: Any = yaml.safe_load("\n".join(read_lines(path)))
        fx, fy, cx, cy = (float(v) for v in sensor["intrinsics"])
        lens = tuple(float(v) for v in sensor.get("distortion_coefficients", ()))
        T_body_cam = np.array(sensor["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
        model = (sensor.get("camera_model", "pinhole"), sensor.get("distortion_model", "radial-tangential"))
    except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as exc:
        raise DatasetError(f"{path}: is no EuRoC camera calibration: {type(exc).__name__}: {exc}") from exc
    if model not in (("pinhole", "radial-tangential"), ("pinhole", "radtan")):
        raise DatasetError(f"{path}: has camera model {model[0]}, {model[1]}; expected pinhole, radial-tangential")
    try:
        return PinholeCamera(fx, fy, cx, cy, *size, lens), T_body_cam
    except PoseError as exc:
        raise DatasetError(f"{path}: {exc}") from exc
