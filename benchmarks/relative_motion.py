"""Relative motion against the truth, by stride and by parallax; where the time goes.

python benchmarks/relative_motion.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from common import DATA, REDKITCHEN, parser_of, write_table
from scipy.spatial.transform import Rotation

from conformodal.corridor import write_corridor
from conformodal.geometry import RelativeMotion, Trajectory
from conformodal.io import Recording, read_recording
from conformodal.tracking.tracker import MotionFrontEnd

N_FRAMES = 1000


def measure(sequence: Recording, stride: int) -> list[tuple[int, RelativeMotion]]:
    """Frames at the end of a stride, and their motion since its start."""
    front_end = MotionFrontEnd(sequence.camera)
    motions = []
    for i in range(min(N_FRAMES, len(sequence))):
        image = sequence.image(i)
        if i % stride:
            front_end.track_only(image)
        elif (motion := front_end.measure(image)) is not None:
            motions.append((i, motion))
    return motions


def jitter_m(truth: Trajectory) -> float:
    """White noise of true positions, per axis: fourth differences leave little else of a hand's motion."""
    fourth = np.diff(truth.positions_xyz, n=4, axis=0)
    return float(np.median(np.abs(fourth)) / 0.6745 / np.sqrt(70))


def row(name: str, sequence: Recording, stride: int, jitter: float = 0.0) -> list[str]:
    poses = sequence.require_truth().poses_se3
    motions = measure(sequence, stride)
    rotation_deg, rotation_z, direction_deg, direction_z, trusted_deg = [], [], [], [], []
    for i, motion in motions:
        truth = np.linalg.inv(poses[i - stride]) @ poses[i]
        if motion.R_prev_next is not None:
            error = Rotation.from_matrix(motion.R_prev_next.T @ truth[:3, :3]).as_rotvec()
            rotation_deg.append(np.degrees(np.linalg.norm(error)))
            rotation_z.append(np.linalg.norm(error) / motion.rotation_sigma_rad)
        length = np.linalg.norm(truth[:3, 3])
        if motion.direction_prev is not None and length > 0:
            angle = np.arccos(np.clip(motion.direction_prev @ truth[:3, 3] / length, -1, 1))
            direction_deg.append(np.degrees(angle))
            direction_z.append(angle / np.hypot(motion.direction_sigma_rad, np.sqrt(2) * jitter / length))
            if motion.direction_sigma_rad <= np.radians(10):
                trusted_deg.append(np.degrees(angle))
    # medians of the lengths of standard normal vectors in three and two dimensions
    claims = f"{np.median(rotation_z) / 1.538:.2f} / {np.median(direction_z) / 1.177:.2f}"
    return [
        name,
        str(stride),
        f"{np.median(rotation_deg):.2f} / {np.percentile(rotation_deg, 90):.2f}",
        f"{np.median(direction_deg):.1f} / {np.percentile(direction_deg, 90):.1f}",
        f"{len(direction_deg) / len(motions):.2f}",
        f"{np.median(trusted_deg):.1f} / {np.percentile(trusted_deg, 90):.1f}",
        f"{len(trusted_deg) / len(motions):.2f}",
        claims,
    ]


def read_kitti() -> Recording:
    """KITTI odometry 06, the frames that are there."""
    return read_recording(DATA / "kitti" / "sequences" / "06")


def main() -> None:
    parser_of(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        write_corridor(Path(scratch), n_laps=1)
        corridor = read_recording(scratch)
        video = read_recording(REDKITCHEN)
        jitter = jitter_m(video.require_truth())
        rows = [row("redkitchen 640x480", video, s, jitter=jitter) for s in (1, 5, 10)]
        rows += [row("corridor 160x120", corridor, s) for s in (1, 3, 5)]
        rows += [row("KITTI 06 1226x370", read_kitti(), 1)]
    header = ["data", "stride", "rotation error, deg (median / 90 %)", "direction error, deg (median / 90 %)"]
    header += ["share with direction", "where trusted", "share trusted"]
    header += ["error / claimed spread (rotation / direction)"]
    title = f"Relative motion, first {N_FRAMES} frames"
    note = (
        "Trusted: a claimed spread of at most 10 degrees. An error of 1 claimed spread is honest (of medians); "
        f"redkitchen's true positions have jitter of their own, {1e3 * jitter:.1f} mm per axis by their fourth "
        "differences, which is added to the claim."
    )
    write_table("relative_motion", title, "python benchmarks/relative_motion.py", header, rows, note)


if __name__ == "__main__":
    main()
