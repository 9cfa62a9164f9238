"""Fixes of held-out frames from landmarks alone: how many, how far off, in metres and in what they claim; and the time.

python benchmarks/landmarks.py
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import DATA, write_table
from relative_motion import read_kitti

from conformodal.datasets import PixelNoise, Sequence, SplitKind, make_split, read_sevenscenes
from conformodal.datasets.corridor import write_corridor
from conformodal.experiments.engine.threads import limit_threads
from conformodal.motion import describe
from conformodal.odometry import learn_scene
from conformodal.poses import PoseFix, angle_between_quats

SEED = 0
CALIBRATION_SHARE = 0.2  # of the used frames
_MEDIAN_OF_NORM3 = 1.538


def rows(name: str, sequence: Sequence, kind: SplitKind, used: float, sigmas: tuple[float, ...]) -> list[list[str]]:
    split = make_split(sequence.recording, kind, seed=SEED, calibration=CALIBRATION_SHARE * used, used=used)
    started = time.perf_counter()
    landmarks = learn_scene(sequence, split).landmarks
    seconds = time.perf_counter() - started
    assert landmarks is not None
    own = landmarks.map
    found = []
    for sigma in sigmas:
        noisy = replace(sequence, noise=PixelNoise(sigma, SEED) if sigma else None)
        images = [noisy.image(i) for i in split.test]
        started = time.perf_counter()
        described = [describe(image, sequence.camera) for image in images]
        describing = 1e3 * (time.perf_counter() - started) / len(images)
        started = time.perf_counter()
        fixes = [landmarks.fixes(image) for image in described]
        fixing = 1e3 * (time.perf_counter() - started) / len(images)
        truth = sequence.require_truth()
        pairs = [(f, p) for f, p in zip(fixes, truth.positions_xyz[split.test], strict=True) if f]
        trusted = np.array([off(most_trusted(f), p) for f, p in pairs])
        nearest = [min(f, key=lambda fix: off(fix, p)) for f, p in pairs]
        errors = np.array([off(fix, p) for fix, (_, p) in zip(nearest, pairs, strict=True)])
        claims = np.array([fix.sigma_m for fix in nearest]) * _MEDIAN_OF_NORM3
        quats = [q for f, q in zip(fixes, truth.orientations_quat_wxyz[split.test], strict=True) if f]
        turns = [angle_between_quats(fix.orientation_quat_wxyz, q) for fix, q in zip(nearest, quats, strict=True)]
        found.append(
            [
                name,
                str(kind),
                f"{100 * used:g} %",
                f"{sigma:g}",
                f"{sequence.camera.fx:.0f} / {own.camera.fx:.0f}",
                f"{len(own.points_xyz) / len(own.poses_se3):.0f}",
                f"{len(pairs) / len(fixes):.2f}, {np.mean([len(f) for f in fixes]):.1f}",
                f"{1e3 * np.median(errors):.1f} / {1e3 * np.percentile(errors, 90):.0f}",
                f"{np.degrees(np.median(turns)):.2f}",
                f"{np.median(errors / claims):.2f} / {np.percentile(errors / claims, 90):.2f}",
                f"{1e3 * np.median(trusted):.1f} / {1e3 * np.percentile(trusted, 90):.0f}",
                f"{describing:.1f} + {fixing:.1f}",
                f"{seconds:.0f}",
            ]
        )
    return found


def most_trusted(fixes: list[PoseFix]) -> PoseFix:
    return max(fixes, key=lambda fix: (fix.trust, fix.n_inliers))


def off(fix: PoseFix, position: np.ndarray) -> float:
    return float(np.linalg.norm(fix.position_xyz - position))


def main() -> None:
    limit_threads(1)
    redkitchen = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    found = []
    for kind in (SplitKind.INTERLEAVED, SplitKind.BLOCKS):
        for used in (0.8, 0.4):
            found += rows("redkitchen", redkitchen, kind, used, (0.0, 0.1, 0.2))
    with tempfile.TemporaryDirectory() as scratch:
        write_corridor(Path(scratch), seed=0)
        found += rows("corridor", read_sevenscenes(scratch), SplitKind.INTERLEAVED, 0.8, (0.0,))
    found += rows("KITTI 06", read_kitti(), SplitKind.INTERLEAVED, 0.8, (0.0,))
    header = [
        "data",
        "split",
        "used",
        "noise",
        "focal length given / found, px",
        "landmarks a keyframe",
        "frames with a fix, fixes a frame",
        "nearest fix off, mm",
        "degrees",
        "of the claim",
        "most trusted fix off, mm",
        "ms a frame: corners + fixes",
        "s to learn, both maps",
    ]
    note = (
        "Each frame alone: no network, no motion. Off: median and 90th percentile. Nearest: of a frame's fixes the one "
        "nearest to the truth, which is what candidates are made of; most trusted: the one a user without a network "
        "would take. One thread; learning includes reading images, depths and the frames left out to measure "
        f"errors. Seed {SEED}; corners of training and calibration frames are mapped, as for the search, test frames "
        "are not seen. A second map, of the training part alone, which regions use, is learnt in the same seconds."
    )
    write_table("landmarks", "Landmarks", "python benchmarks/landmarks.py", header, found, note)


if __name__ == "__main__":
    main()
