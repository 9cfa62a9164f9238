"""What a layout has beside its images: times, camera, poses."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.poses import PinholeCamera, Trajectory, matrix_from_quat_wxyz

from .colmap_binary import model_number
from .layouts import Layout

_UNEVEN = 0.2  # of a frame's time
_MOST_NUMBERED = 999_999  # six digits
_USUAL_HZ = 30.0
_CAMERA = 1  # the number of the only camera of a COLMAP model


@dataclass(frozen=True, eq=False)
class WrittenFrames:
    """Frames whose images are written.

    Attributes
    ----------
    names
        Of the files, from the layout's folder of images.
    times
        (n,) seconds, strictly increasing.
    recording
        (n,) number of each frame's recording.
    poses
        (n, 7) rows ``x y z qw qx qy qz`` of camera to world, NaN where there is none; None for frames without truth.
    """

    names: list[str]
    times: FloatArray
    recording: IntArray
    poses: FloatArray | None

    def posed(self) -> tuple[list[int], Trajectory | None]:
        """Which frames have a pose, and their poses."""
        if self.poses is None:
            return [], None
        at = np.flatnonzero(np.isfinite(self.poses).all(axis=1))
        return at.tolist(), Trajectory(self.times[at], self.poses[at, :3], self.poses[at, 3:])


Finish = Callable[[Path, WrittenFrames, PinholeCamera], list[str]]


def _numbered_by_time(times: FloatArray, recording: IntArray) -> tuple[float, IntArray, bool]:
    """Frame rate, number of every frame in its recording, and whether both say its time.

    Frames that are missing leave a gap in the numbers. Times that no rate fits are numbered one after the other.
    """
    first = np.flatnonzero(np.diff(recording, prepend=-1) != 0)
    start = np.repeat(first, np.diff(np.append(first, len(times))))
    counted = np.arange(len(times)) - start
    inner = np.flatnonzero(np.diff(recording) == 0)
    steps = np.diff(times)[inner]
    if not steps.size:
        return _USUAL_HZ, counted, True
    passed = times - times[start]
    for step in (np.median(steps), steps.min()):  # where most frames are missing, few steps are of one frame
        rise = np.zeros(len(times))
        rise[inner + 1] = np.maximum(np.rint(steps / step), 1)
        total = np.cumsum(rise)
        numbers = total - total[start]
        rate = float(numbers @ numbers / (numbers @ passed))
        if np.abs(passed * rate - numbers).max() <= _UNEVEN and numbers.max() <= _MOST_NUMBERED:
            return rate, numbers.astype(np.int64), True
    return 1 / float(np.median(steps)), counted, False


def _finish_sevenscenes(folder: Path, frames: WrittenFrames, camera: PinholeCamera) -> list[str]:
    """Give images the numbers that say their times, poses beside them, camera and rate; says what was lost."""
    rate, numbers, even = _numbered_by_time(frames.times, frames.recording)
    names = list(frames.names)
    for i in reversed(range(len(names))):  # numbers only grow, so the place of the new name is free
        old = folder / names[i]
        new = old.with_name(f"frame-{numbers[i]:06d}.color{old.suffix}")
        names[i] = str(new.relative_to(folder))
        if new != old:
            old.rename(new)
    at, truth = frames.posed()
    if truth is not None:
        for i, pose in zip(at, truth.poses_se3, strict=True):
            path = folder / names[i]
            np.savetxt(path.with_name(f"{path.name.split('.')[0]}.pose.txt"), pose, fmt="%.17g")
    np.savetxt(folder / "frame-rate.txt", [rate])
    _camera_beside(folder, camera)
    return [] if even else [f"7scenes has no timestamps: they are read back as even, {rate:.3f} Hz"]


def _finish_tum(folder: Path, frames: WrittenFrames, camera: PinholeCamera) -> list[str]:
    """Write the list of images, the camera and the poses."""
    lines = [f"{time:.9f} rgb/{name}" for time, name in zip(frames.times.tolist(), frames.names, strict=True)]
    _write_lines(folder / "rgb.txt", ["# timestamp filename", *lines])
    _camera_beside(folder, camera)
    _tum_poses(folder / "groundtruth.txt", frames)
    return []


def _finish_images(folder: Path, frames: WrittenFrames, camera: PinholeCamera) -> list[str]:
    """Write times, camera and poses."""
    _times(folder, frames)
    _camera_beside(folder, camera)
    _tum_poses(folder / "poses.tum", frames)
    return []


def _finish_colmap(folder: Path, frames: WrittenFrames, camera: PinholeCamera) -> list[str]:
    """Write a model as text, in which frames without a pose are not registered, and the times of all."""
    return _write_model(folder, frames, camera, binary=False)


def finish_colmap_binary(folder: Path, frames: WrittenFrames, camera: PinholeCamera) -> list[str]:
    """Write the same model in COLMAP's binary files."""
    return _write_model(folder, frames, camera, binary=True)


def _write_model(folder: Path, frames: WrittenFrames, camera: PinholeCamera, *, binary: bool) -> list[str]:
    at, truth = frames.posed()
    assert truth is not None
    _write_colmap(folder / "sparse" / "0", [frames.names[i] for i in at], truth, camera, binary=binary)
    _times(folder, frames)
    return []


def _times(folder: Path, frames: WrittenFrames) -> None:
    np.savetxt(folder / "times.txt", frames.times, fmt="%.9f")


def _camera_beside(folder: Path, camera: PinholeCamera) -> None:
    np.savetxt(folder / "camera-intrinsics.txt", camera.matrix)
    if camera.distortion:
        np.savetxt(folder / "camera-distortion.txt", camera.distortion)


def _tum_poses(path: Path, frames: WrittenFrames) -> None:
    _, truth = frames.posed()
    if truth is None:
        return
    q = truth.orientations_quat_wxyz
    rows = np.column_stack((truth.positions_xyz, q[:, 1:], q[:, :1])).tolist()
    lines = [f"{t:.9f} {' '.join(map(repr, row))}" for t, row in zip(truth.timestamps_s.tolist(), rows, strict=True)]
    _write_lines(path, ["# timestamp tx ty tz qx qy qz qw", *lines])


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_colmap(place: Path, names: list[str], truth: Trajectory, camera: PinholeCamera, *, binary: bool) -> None:
    """Write a model of one camera with its images' poses (camera to world) into a new folder."""
    place.mkdir(parents=True)
    model, values = _parameters(camera)
    rows = _world_to_camera(truth).tolist()
    if binary:
        (place / "points3D.bin").write_bytes(struct.pack("<Q", 0))
        size = struct.pack("<iiQQ", _CAMERA, model_number(model), camera.width, camera.height)
        content = struct.pack(f"<{len(values)}d", *values)
        (place / "cameras.bin").write_bytes(struct.pack("<Q", 1) + size + content)
        images = [
            struct.pack("<i7di", number, *row, _CAMERA) + name.encode() + b"\0" + struct.pack("<Q", 0)
            for number, (name, row) in enumerate(zip(names, rows, strict=True), start=1)
        ]
        (place / "images.bin").write_bytes(b"".join([struct.pack("<Q", len(images)), *images]))
        return
    parameters = " ".join(map(repr, values))
    cameras = ["# id model width height parameters", f"{_CAMERA} {model} {camera.width} {camera.height} {parameters}"]
    lines = ["# id qw qx qy qz tx ty tz camera name, world to camera; after it a line of points, here empty"]
    for number, (name, row) in enumerate(zip(names, rows, strict=True), start=1):
        lines += [f"{number} {' '.join(map(repr, row))} {_CAMERA} {name}", ""]
    for stem, content_lines in (("cameras", cameras), ("images", lines), ("points3D", ["# holds no point"])):
        (place / f"{stem}.txt").write_text("\n".join(content_lines) + "\n", encoding="utf-8")


def _parameters(camera: PinholeCamera) -> tuple[str, list[float]]:
    """COLMAP's model that says a camera, and the model's parameters."""
    pixels = [float(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy)]
    lens = [float(v) for v in camera.distortion]
    if not lens:
        return "PINHOLE", pixels
    if len(lens) == 4:
        return "OPENCV", pixels + lens
    return "FULL_OPENCV", pixels + lens + [0.0] * 3


def _world_to_camera(truth: Trajectory) -> FloatArray:
    """Rows ``qw qx qy qz tx ty tz`` (n, 7)."""
    back = truth.orientations_quat_wxyz * (1, -1, -1, -1)
    shifts = -np.einsum("nij,nj->ni", matrix_from_quat_wxyz(back), truth.positions_xyz)
    return np.column_stack((back, shifts))


# By layout; COLMAP's binary files are asked for.
FINISH: dict[Layout, Finish] = {
    Layout.SEVENSCENES: _finish_sevenscenes,
    Layout.TUM: _finish_tum,
    Layout.IMAGES: _finish_images,
    Layout.COLMAP: _finish_colmap,
}
