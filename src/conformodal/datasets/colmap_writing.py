"""Writing COLMAP models without points, as text or in binary files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.poses import PinholeCamera, Trajectory, matrix_from_quat_wxyz

from .colmap_binary import model_number

_CAMERA = 1  # the number of the only one


def write_colmap(place: Path, names: list[str], truth: Trajectory, camera: PinholeCamera, *, binary: bool) -> None:
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
    said = " ".join(map(repr, values))
    cameras = ["# id model width height parameters", f"{_CAMERA} {model} {camera.width} {camera.height} {said}"]
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
