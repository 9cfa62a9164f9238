"""Relative motion against the truth, by stride and by parallax; where the time goes.

python benchmarks/relative_motion.py
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import DATA, REDKITCHEN, write_table
from scipy.spatial.transform import Rotation

from conformodal.corridor.writer import write_corridor
from conformodal.geometry import PinholeCamera, RelativeMotion, Trajectory
from conformodal.io import Recording, read_sevenscenes
from conformodal.tracking.frontend import MotionFrontEnd
from conformodal.tracking.two_view import TwoViewSolver, solve_opencv, solve_poselib

N_FRAMES = 1000
PARTS = ("flow", "geometry", "corners")
# Of redkitchen, where the poses speak for another than the given 585.
FOUND_FOCAL_PX = 505.0


class TimedFrontEnd(MotionFrontEnd):
    """The front end with a stop watch on its parts."""

    def __init__(self, camera: PinholeCamera, solver: TwoViewSolver) -> None:
        super().__init__(camera, solver=solver)
        self.seconds: dict[str, list[float]] = {part: [] for part in PARTS}
        self.tracker.advance = self._timed("flow", self.tracker.advance)  # type: ignore[method-assign]
        self._since_mark = self._timed("geometry", self._since_mark)  # type: ignore[method-assign]
        self.tracker.mark = self._timed("corners", self.tracker.mark)  # type: ignore[method-assign]

    def _timed(self, part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            started = time.perf_counter()
            result = work(*arguments)
            self.seconds[part].append(time.perf_counter() - started)
            return result

        return timed


def measure(
    sequence: Recording, stride: int, solver: TwoViewSolver
) -> tuple[list[tuple[int, RelativeMotion]], float, str]:
    front_end = TimedFrontEnd(sequence.camera, solver)
    found = []
    seconds = []
    for i in range(min(N_FRAMES, len(sequence))):
        image = sequence.image(i)
        started = time.perf_counter()
        if i % stride:
            front_end.track_only(image)
        else:
            motion = front_end.measure(image)
            if motion is not None:
                found.append((i, motion))
        seconds.append(time.perf_counter() - started)
    parts = " / ".join(f"{1e3 * float(np.median(front_end.seconds[part][5:])):.1f}" for part in PARTS)
    return found, 1e3 * float(np.median(seconds[20:])), parts


def jitter_m(truth: Trajectory) -> float:
    """White noise of true positions, an axis: fourth differences leave little else of a hand's motion."""
    fourth = np.diff(truth.positions_xyz, n=4, axis=0)
    return float(np.median(np.abs(fourth)) / 0.6745 / np.sqrt(70))


def row(
    name: str, sequence: Recording, stride: int, solver: TwoViewSolver = solve_poselib, jitter: float = 0.0
) -> list[str]:
    poses = sequence.require_truth().poses_se3
    found, milliseconds, parts = measure(sequence, stride, solver)
    turns, turn_z, ways, way_z, trusted = [], [], [], [], []
    for i, motion in found:
        truth = np.linalg.inv(poses[i - stride]) @ poses[i]
        if motion.R_prev_next is not None:
            error = Rotation.from_matrix(motion.R_prev_next.T @ truth[:3, :3]).as_rotvec()
            turns.append(np.degrees(np.linalg.norm(error)))
            turn_z.append(np.linalg.norm(error) / motion.rotation_sigma_rad)
        length = np.linalg.norm(truth[:3, 3])
        if motion.direction_prev is not None and length > 0:
            angle = np.arccos(np.clip(motion.direction_prev @ truth[:3, 3] / length, -1, 1))
            ways.append(np.degrees(angle))
            way_z.append(angle / np.hypot(motion.direction_sigma_rad, np.sqrt(2) * jitter / length))
            if motion.direction_sigma_rad <= np.radians(10):
                trusted.append(np.degrees(angle))
    # medians of the lengths of standard normal vectors in three and two dimensions
    claims = f"{np.median(turn_z) / 1.538:.2f} / {np.median(way_z) / 1.177:.2f}"
    return [
        name,
        str(stride),
        f"{np.median(turns):.2f} / {np.percentile(turns, 90):.2f}",
        f"{np.median(ways):.1f} / {np.percentile(ways, 90):.1f}",
        f"{len(ways) / len(found):.2f}",
        f"{np.median(trusted):.1f} / {np.percentile(trusted, 90):.1f}",
        f"{len(trusted) / len(found):.2f}",
        claims,
        f"{milliseconds:.1f}",
        parts,
    ]


def with_focal_length(sequence: Recording, focal_px: float) -> Recording:
    """The same images, believed to be of another focal length."""
    return replace(sequence, camera=replace(sequence.camera, fx=focal_px, fy=focal_px))


def read_kitti() -> Recording:
    """KITTI odometry 06, the frames that are there; 10 Hz."""
    folder = DATA / "kitti" / "sequences" / "06"
    images = sorted((folder / "image_0").iterdir())
    first = (folder / "calib.txt").read_text().splitlines()[0].split()[1:]
    fx, _, cx, _, _, fy, cy, *_ = map(float, first)
    height, width = cv2.imread(str(images[0]), cv2.IMREAD_GRAYSCALE).shape
    poses = np.loadtxt(DATA / "kitti" / "poses" / "06.txt").reshape(-1, 3, 4)
    quats = Rotation.from_matrix(poses[:, :, :3]).as_quat(scalar_first=True)
    times = np.arange(len(images)) / 10
    camera = PinholeCamera(fx, fy, cx, cy, width, height)
    truth = Trajectory(times, poses[:, :, 3], quats)
    return Recording("kitti 06", tuple(images), times, np.zeros(len(images), dtype=np.int64), camera, truth)


def main() -> None:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as scratch:
        write_corridor(Path(scratch), n_laps=1)
        corridor = read_sevenscenes(scratch)
        video = read_sevenscenes(REDKITCHEN)
        jitter = jitter_m(video.require_truth())
        rows = [row("redkitchen 640x480", video, s, jitter=jitter) for s in (1, 5, 10)]
        rows += [row("the same, OpenCV's five points", video, s, solve_opencv, jitter) for s in (1, 5)]
        refocused = with_focal_length(video, FOUND_FOCAL_PX)
        rows += [row(f"the same, focal length {FOUND_FOCAL_PX:g} px", refocused, s, jitter=jitter) for s in (1, 5)]
        rows += [row("corridor 160x120", corridor, s) for s in (1, 3, 5)]
        rows += [row("KITTI 06 1226x370", read_kitti(), 1)]
        rows += [row("the same, OpenCV's five points", read_kitti(), 1, solve_opencv)]
    header = [
        "data",
        "stride",
        "rotation error, deg (median / 90 %)",
        "direction error, deg (median / 90 %)",
        "share with direction",
        "where trusted",
        "share trusted",
        "error / claimed spread (rotation / direction)",
        "ms per frame",
        f"of these: {', '.join(PARTS)}",
    ]
    title = f"Relative motion, first {N_FRAMES} frames"
    note = (
        "One OpenCV thread; without decoding; medians. Trusted: a claimed spread of at most 10 degrees. An error of 1 "
        "claimed spread is honest (of medians); redkitchen's true positions have jitter of their own, "
        f"{1e3 * jitter:.1f} mm an axis by their fourth differences, which is added to the claim. Flow "
        "runs on every frame, geometry and the search for new corners on those that end a stride."
    )
    write_table("relative_motion", title, "python benchmarks/relative_motion.py", header, rows, note)


if __name__ == "__main__":
    main()
