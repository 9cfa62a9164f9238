"""Relative motion against the truth, by stride and by parallax; where the time goes.

python benchmarks/relative_motion.py
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from common import DATA, write_table
from scipy.spatial.transform import Rotation

from conformodal.datasets import Sequence, read_sevenscenes
from conformodal.datasets.corridor import write_corridor
from conformodal.motion import MotionFrontEnd
from conformodal.poses import PinholeCamera, RelativeMotion, Trajectory

N_FRAMES = 600


def measure(sequence: Sequence, stride: int) -> tuple[list[tuple[int, RelativeMotion]], float]:
    front_end = MotionFrontEnd(sequence.camera)
    found = []
    seconds = []
    for i in range(min(N_FRAMES, len(sequence))):
        image = sequence.image(i)
        started = time.perf_counter()
        if i % stride:
            front_end.pass_by(image)
        else:
            motion = front_end.measure(image)
            if motion is not None:
                found.append((i, motion))
        seconds.append(time.perf_counter() - started)
    return found, 1e3 * float(np.median(seconds[20:]))


def row(name: str, sequence: Sequence, stride: int) -> list[str]:
    poses = sequence.require_truth().poses_se3
    found, milliseconds = measure(sequence, stride)
    turns, turn_z, ways, way_z = [], [], [], []
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
            way_z.append(angle / motion.direction_sigma_rad)
    # medians of the lengths of standard normal vectors in three and two dimensions
    claims = f"{np.median(turn_z) / 1.538:.2f} / {np.median(way_z) / 1.177:.2f}"
    return [
        name,
        str(stride),
        f"{np.median(turns):.2f} / {np.percentile(turns, 90):.2f}",
        f"{np.median(ways):.1f} / {np.percentile(ways, 90):.1f}",
        f"{len(ways) / len(found):.2f}",
        claims,
        f"{milliseconds:.1f}",
    ]


def read_kitti() -> Sequence:
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
    return Sequence("kitti 06", tuple(images), times, np.zeros(len(images), dtype=np.int64), camera, truth)


def main() -> None:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as scratch:
        write_corridor(Path(scratch), n_laps=1)
        corridor = read_sevenscenes(scratch)
        video = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
        rows = [row("redkitchen 640x480", video, s) for s in (1, 5, 10)]
        rows += [row("corridor 160x120", corridor, s) for s in (1, 3, 5)]
        rows += [row("KITTI 06 1226x370", read_kitti(), 1)]
    header = [
        "data",
        "stride",
        "rotation error, deg (median / 90 %)",
        "direction error, deg (median / 90 %)",
        "share with direction",
        "error / claimed spread (rotation / direction)",
        "ms a frame",
    ]
    title = f"Relative motion, first {N_FRAMES} frames"
    note = "One OpenCV thread; without decoding. A ratio of 1 in the sixth column is an honest spread (of medians)."
    write_table("relative_motion", title, "python benchmarks/relative_motion.py", header, rows, note)


if __name__ == "__main__":
    main()
