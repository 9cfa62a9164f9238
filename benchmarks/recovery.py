"""Recovery in the corridor, where the right mode is known: how many usable frames until the online answer is right.

python benchmarks/recovery.py
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import spread, write_table

from conformodal.cli.demo import ALPHA, N_LAPS, N_MODULES, TRAINING
from conformodal.datasets import read_sevenscenes
from conformodal.datasets.corridor import write_corridor
from conformodal.datasets.corridor.world import MODULE_LENGTH
from conformodal.odometry import ModelConfig, OdometryRun, VisualOdometry, prepare_training_data, train_model
from conformodal.poses import Trajectory
from conformodal.reasoning import Candidates, OnlineReasoner
from conformodal.vision import FeatureCache

SEEDS, LAG, COVERED, HORIZON, EVERY = 3, 30, 30, 60, 7
KINDS = ("fresh start", "wrong start", "covered for 30 frames", "moved while blind")


def frames_to_recover(
    reasoner: OnlineReasoner, run: OdometryRun, truth: Trajectory, start: int, first_linked: bool
) -> int | None:
    """Frames from `start` until the answer is, and for five frames stays, in the right room; None if never."""
    right = []
    for i in range(start, min(start + HORIZON + 5, len(run.frames))):
        motion = run.motions[i] if i > start or first_linked else None
        path = reasoner.push(run.candidates[i], motion, float(run.timestamps_s[i]))
        right.append(np.linalg.norm(path.positions_xyz[-1] - truth.positions_xyz[i]) < MODULE_LENGTH / 2)
    good = [k for k in range(len(right) - 4) if all(right[k : k + 5])]
    return good[0] + 1 if good else None


def certain(position: np.ndarray, quat: np.ndarray, like: Candidates) -> Candidates:
    """A belief in one pose alone."""
    spreads, turn = like.position_spreads[:1], like.orientation_spreads_rad[:1]
    return Candidates(position[None], spreads, quat[None], turn, np.zeros(1))


def trials(kind: str, run: OdometryRun, truth: Trajectory, model_prior: object) -> list[int | None]:
    found = []
    n = len(run.frames)
    for start in range(60, n - HORIZON, EVERY):
        reasoner = OnlineReasoner(model_prior, LAG)  # type: ignore[arg-type]
        if kind == "fresh start":
            found.append(frames_to_recover(reasoner, run, truth, start, False))
        elif kind == "wrong start":
            # certain of a place some rooms away, and the motion from there on is linked
            away = truth.positions_xyz[start - 1] + [3 * MODULE_LENGTH * (-1) ** start, 0, 0]
            quat = truth.orientations_quat_wxyz[start - 1]
            reasoner.push(certain(away, quat, run.candidates[start]), None, float(run.timestamps_s[start - 1]))
            found.append(frames_to_recover(reasoner, run, truth, start, True))
        else:
            before = range(start - 60, start - COVERED) if "covered" in kind else range(30)
            if "moved" in kind and start < 120:
                continue
            for i in before:
                shift = 0.0 if "covered" in kind else float(run.timestamps_s[start - 1] - run.timestamps_s[29] - 1 / 30)
                reasoner.push(run.candidates[i], run.motions[i] if i > before[0] else None, run.timestamps_s[i] + shift)
            found.append(frames_to_recover(reasoner, run, truth, start, False))
    return found


def main() -> None:
    results: dict[str, list[tuple[float, float, float]]] = {kind: [] for kind in KINDS}
    counts = dict.fromkeys(KINDS, 0)
    for seed in range(SEEDS):
        with tempfile.TemporaryDirectory() as scratch:
            write_corridor(Path(scratch), n_modules=N_MODULES, n_laps=N_LAPS, seed=seed)
            sequence = read_sevenscenes(scratch)
            config = ModelConfig(alpha=ALPHA, seed=seed, training=replace(TRAINING, seed=seed))
            cache = FeatureCache(Path(scratch) / "cache")
            model = train_model(prepare_training_data(sequence, config, cache), config)
            run = VisualOdometry(model).process(sequence, model.split.test, cache=cache)
        truth = sequence.require_truth()[run.frames]
        for kind in KINDS:
            found = trials(kind, run, truth, model.prior)
            counts[kind] += len(found)
            frames = np.array([np.inf if f is None else f for f in found])
            results[kind].append((float((frames <= 20).mean()), float(np.median(frames)), float((frames <= 60).mean())))
    rows = []
    for kind in KINDS:
        within, median, ever = (list(column) for column in zip(*results[kind], strict=True))
        rows.append([kind, str(counts[kind]), spread(within, 2), spread(median, 0), spread(ever, 2)])
    notes = (
        f"Corridor of {N_MODULES} modules, {N_LAPS} laps; test frames of the `interleaved` split, lag {LAG}; median "
        f"(range) over seeds 0 to {SEEDS - 1}. Right: less than half a module from the truth, for five frames running. "
        "Fresh start: no past, which is the best that images and motion allow. Wrong start: certain of a place three "
        "modules away. Moved: 30 frames elsewhere, then the camera is here, with nothing known of the way."
    )
    header = ["what happened", "trials", "right within 20 frames", "frames until right (median)", "within 60"]
    write_table("recovery", "Recovery of the online reasoner", "python benchmarks/recovery.py", header, rows, notes)


if __name__ == "__main__":
    main()
