"""Pose estimates of held-out frames by landmarks alone: how many, their errors, in metres and in sigmas; and the time.

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
from conformodal.localization import LandmarkSource, PoseMeasurement, SourceData, extract_local_features, pose_targets
from conformodal.odometry import measure_depths
from conformodal.poses import angle_between_quats, sign_reference

SEED = 0
CALIBRATION_SHARE = 0.2  # of the used frames
_MEDIAN_OF_NORM3 = 1.538


def rows(name: str, sequence: Sequence, kind: SplitKind, used: float, sigmas: tuple[float, ...]) -> list[list[str]]:
    split = make_split(sequence.recording, kind, seed=SEED, calibration=CALIBRATION_SHARE * used, used=used)
    started = time.perf_counter()
    truth = sequence.require_truth()
    depth_m, _ = measure_depths(sequence, split.train)
    reference = sign_reference(truth.orientations_quat_wxyz)
    nothing = np.zeros((len(sequence), 1), dtype=np.float32)
    data = SourceData(sequence, nothing, pose_targets(truth, reference), reference, kind, depth_m)
    landmarks = LandmarkSource.fit(data, np.sort(np.concatenate((split.train, split.calibration))))
    seconds = time.perf_counter() - started
    assert landmarks is not None
    own = landmarks.map
    found = []
    for sigma in sigmas:
        noisy = replace(sequence, noise=PixelNoise(sigma, SEED) if sigma else None)
        images = [noisy.image(i) for i in split.test]
        started = time.perf_counter()
        described = [extract_local_features(image, sequence.camera) for image in images]
        describing = 1e3 * (time.perf_counter() - started) / len(images)
        started = time.perf_counter()
        estimates = [landmarks.localize(image) for image in described]
        localizing = 1e3 * (time.perf_counter() - started) / len(images)
        pairs = [(f, p) for f, p in zip(estimates, truth.positions_xyz[split.test], strict=True) if f]
        probable = np.array([off(most_probable(f), p) for f, p in pairs])
        nearest = [min(f, key=lambda estimate: off(estimate, p)) for f, p in pairs]
        errors = np.array([off(estimate, p) for estimate, (_, p) in zip(nearest, pairs, strict=True)])
        sigmas = np.array([estimate.sigma_m for estimate in nearest]) * _MEDIAN_OF_NORM3
        quats = [q for f, q in zip(estimates, truth.orientations_quat_wxyz[split.test], strict=True) if f]
        turns = [
            angle_between_quats(estimate.orientation_quat_wxyz, q) for estimate, q in zip(nearest, quats, strict=True)
        ]
        found.append(
            [
                name,
                str(kind),
                f"{100 * used:g} %",
                f"{sigma:g}",
                f"{sequence.camera.fx:.0f} / {own.camera.fx:.0f}",
                f"{len(own.points_xyz) / len(own.poses_se3):.0f}",
                f"{len(pairs) / len(estimates):.2f}, {np.mean([len(f) for f in estimates]):.1f}",
                f"{1e3 * np.median(errors):.1f} / {1e3 * np.percentile(errors, 90):.0f}",
                f"{np.degrees(np.median(turns)):.2f}",
                f"{np.median(errors / sigmas):.2f} / {np.percentile(errors / sigmas, 90):.2f}",
                f"{1e3 * np.median(probable):.1f} / {1e3 * np.percentile(probable, 90):.0f}",
                f"{describing:.1f} + {localizing:.1f}",
                f"{seconds:.0f}",
            ]
        )
    return found


def most_probable(estimates: list[PoseMeasurement]) -> PoseMeasurement:
    return max(estimates, key=lambda estimate: (estimate.inlier_probability, estimate.n_inliers))


def off(estimate: PoseMeasurement, position: np.ndarray) -> float:
    return float(np.linalg.norm(estimate.position_xyz - position))


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
        "frames with an estimate, estimates a frame",
        "nearest estimate off, mm",
        "degrees",
        "of sigma",
        "most probable estimate off, mm",
        "ms a frame: local features + PnP",
        "s to learn",
    ]
    note = (
        "Each frame alone: no network, no motion. Off: median and 90th percentile. Nearest: of a frame's estimates the "
        "one nearest to the truth, which is what candidates are made of; most probable: the one a user without a "
        "network would take. One thread; learning includes reading images, depths and the frames left out to measure "
        f"errors. Seed {SEED}; training and calibration frames are mapped, test frames are not seen."
    )
    write_table("landmarks", "Landmarks", "python benchmarks/landmarks.py", header, found, note)


if __name__ == "__main__":
    main()
