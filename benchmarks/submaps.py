"""Submaps against the truth: how far off their paths are, in metres and in what they claim; depths; and the time.

python benchmarks/submaps.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from common import REDKITCHEN, parser_of, write_table
from relative_motion import read_kitti
from scipy.spatial.transform import Rotation

from conformodal.corridor import write_corridor
from conformodal.io import PixelNoise, Recording, read_recording
from conformodal.io.decoding import grey_image
from conformodal.tracking.submaps import build_submaps
from conformodal.tracking.tracker import CornerTracker

N_FRAMES = 1000
_MEDIAN_OF_NORM3 = 1.538


def row(name: str, sequence: Recording, stride: int) -> list[str]:
    truth = sequence.require_truth()
    tracker, corners, answered = CornerTracker(), [], []
    for i in range(min(N_FRAMES, len(sequence))):
        tracker.advance(grey_image(sequence.image(i)))
        if i % stride == 0:
            tracker.mark()
            corners.append(tracker.corners())
            answered.append(i)
    submaps = build_submaps(corners, sequence.camera)
    errors, claims, rotations, depths = [], [], [], []
    for submap in submaps:
        frames = np.array(answered)[submap.frames]
        places = truth.positions_xyz[frames]
        world = Rotation.from_quat(truth.orientations_quat_wxyz[frames], scalar_first=True)
        path = world[0].apply(submap.positions)
        about, around = path - path.mean(axis=0), places - places.mean(axis=0)
        length = float((about * around).sum() / (about**2).sum())  # start and length are not the submap's to know
        errors.append(float(np.sqrt(((length * about - around) ** 2).mean())))
        claims.append(errors[-1] / max(submap.sigma * length, 1e-9))
        relative = (world[0].inv() * world[1:]).inv() * Rotation.from_matrix(submap.R_anchor_frame[1:])
        rotations.append(float(np.median(relative.magnitude())) / _MEDIAN_OF_NORM3 / submap.rotation_sigma_rad)
        depths.append(np.log(submap.depth * length) if length > 0 else np.nan)
    spans = [s.span for s in submaps]
    covered = len(np.unique(np.concatenate([np.arange(s.frames[0], s.frames[-1] + 1) for s in submaps])))
    return [
        name,
        str(stride),
        f"{len(submaps)}",
        f"{np.median(spans):.0f} ({min(spans)} to {max(spans)})",
        f"{covered / len(corners):.2f}",
        f"{1e3 * np.median(errors):.1f} / {1e3 * np.percentile(errors, 90):.1f}",
        f"{np.median(claims):.2f} / {np.percentile(claims, 90):.2f}",
        f"{np.median(rotations):.2f} / {np.percentile(rotations, 90):.2f}",
        f"{np.exp(np.nanmedian(depths)):.1f}, {np.nanstd(depths):.2f}",
    ]


def main() -> None:
    parser_of(__doc__).parse_args()
    redkitchen = read_recording(REDKITCHEN)
    noisy = Recording(**{**vars(redkitchen), "noise": PixelNoise(0.1, 0)})
    rows = [row("redkitchen", redkitchen, 1), row("redkitchen", redkitchen, 5), row("redkitchen, noise 0.1", noisy, 5)]
    with tempfile.TemporaryDirectory() as scratch:
        write_corridor(Path(scratch), n_modules=6, n_laps=1, seed=0)
        rows.append(row("corridor", read_recording(scratch), 1))
    rows.append(row("KITTI 06", read_kitti(), 1))
    header = ["data", "stride", "submaps", "frames of one", "frames in one", "off per axis, mm"]
    header += ["error / claimed spread", "rotation / claimed", "depth, m, and spread of log"]
    note = (
        "Off: root mean square of a submap's positions against the true ones where its start and length are given the "
        "best way, median and 90th percentile. The claim is wider by design: errors of neighbouring frames are alike, "
        "so that nine of them say little more than four."
    )
    write_table("submaps", "Submaps", "python benchmarks/submaps.py", header, rows, note)


if __name__ == "__main__":
    main()
