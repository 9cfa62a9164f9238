"""What each part of the reasoning is worth, against the best candidate and the classical regressor; and its cost.

python benchmarks/reasoning.py [--seeds 3]
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import DATA, spread, write_table

from conformodal.cli.demo import ALPHA, N_LAPS, N_MODULES, TRAINING
from conformodal.datasets import Sequence, SplitKind, read_sevenscenes
from conformodal.datasets.corridor import write_corridor
from conformodal.datasets.corridor.world import MODULE_LENGTH
from conformodal.experiments import opponents_training, train_classical
from conformodal.odometry import ModelConfig, VisualOdometry, prepare_training_data, train_model
from conformodal.poses import RelativeMotion, angle_between_quats, normalise_quat
from conformodal.reasoning import (
    MotionPrior,
    Observations,
    OnlineReasoner,
    PosePath,
    fit_spread_scale,
    greedy,
    interval_means,
    mode_candidates,
    online,
    smooth,
    softmax_mean,
    viterbi,
)
from conformodal.vision import FeatureCache, TrainingConfig, default_cache_dir

LONG = 10_000


def without_directions(motions: list[RelativeMotion | None]) -> list[RelativeMotion | None]:
    return [m and replace(m, direction_prev=None, direction_sigma_rad=np.inf) for m in motions]


def methods(
    sequence: Sequence, config: ModelConfig, cache: FeatureCache
) -> tuple[dict[str, PosePath], PosePath, Observations, MotionPrior, float]:
    """Paths of all methods over the test frames, the truth, what reasoning was given, and the error in common.

    The last: root of the mean product of two errors, that of the heads' softmax mean and that of the neighbours.
    """
    data = prepare_training_data(sequence, config, cache)
    model = train_model(data, config)
    run = VisualOdometry(model).process(sequence, model.split.test, cache=cache)
    assert len(np.unique(sequence.recording)) == 1
    features = data.features[run.frames]
    proba = model.proba(features)
    search = model.search(features)
    heads_only = replace(model, local=None)
    times, motions, prior = run.timestamps_s, run.motions, model.prior
    truth = sequence.require_truth()[run.frames]
    fixed = run.observations(np.arange(len(times)))
    seen = replace(fixed, candidates=model.candidates(search))  # without landmarks, as most rows are
    nowhere = np.full((len(times), 3), np.nan)

    def bare(positions: np.ndarray, quats: np.ndarray) -> PosePath:
        return PosePath(times, positions, nowhere, quats, nowhere[:, 0])

    mean = softmax_mean(search.proba, model.bins)
    best_move = [
        np.linalg.norm(c.positions_xyz - p, axis=1).argmin()
        for c, p in zip(seen.candidates, truth.positions_xyz, strict=True)
    ]
    turns = zip(seen.candidates, truth.orientations_quat_wxyz, strict=True)
    best_turn = [int(angle_between_quats(c.orientations_quat_wxyz, q).argmin()) for c, q in turns]
    halves = mode_candidates(search.proba, model.bins, scale=model.scale, strangeness=search.strangeness, mode_bins=0)
    rough = replace(seen, candidates=[model.with_fixes(c, f) for c, f in zip(halves, search.fixes, strict=True)])
    heads_only.scale = fit_spread_scale(
        mode_candidates(model.proba(data.features[model.split.calibration]), model.bins),
        sequence.require_truth()[model.split.calibration],
    )
    no_neighbours = replace(seen, candidates=heads_only.candidates(heads_only.search(features)))
    alone = replace(seen, candidates=mode_candidates(proba, model.bins, scale=heads_only.scale))
    assert model.local is not None
    neighbours = model.local.regression.predict(features).best
    alone_path = viterbi(alone, prior)
    chosen = viterbi(seen, prior)
    blind = replace(seen, motions=without_directions(motions))
    apart = replace(seen, submaps=())
    still = replace(seen, motions=[None] * len(times))
    intervals = interval_means(proba, model.calibration.predict(proba))
    found = {
        "softmax mean": bare(mean[:, :3], normalise_quat(mean[:, 3:])),
        "greedy, the paper's reasoning": greedy(intervals, seen.motions, seen.timestamps_s),
        "viterbi, no relative motion": viterbi(still, prior),
        "viterbi, near peaks split at half their height": viterbi(rough, prior),
        "neighbours alone": bare(neighbours[:, :3], normalise_quat(neighbours[:, 3:])),
        "viterbi, without the finders and neighbours": alone_path,
        "viterbi, without the neighbours": viterbi(no_neighbours, prior),
        "viterbi, without landmarks": chosen,
        "online, lag 0": online(seen, prior, 0),
        "online, lag 10": online(seen, prior, 10),
        "best candidate (knows the truth)": PosePath.choose(seen.candidates, times, best_move, best_turn),
        "smoother, no relative directions": smooth(chosen, blind, prior),
        "smoother, no submaps": smooth(chosen, apart, prior),
        "smoother, without the finders and neighbours": smooth(alone_path, alone, prior),
        "smoother, without the neighbours": smooth(viterbi(no_neighbours, prior), no_neighbours, prior),
        "smoother, without landmarks": smooth(chosen, seen, prior),
        "viterbi, with landmarks": viterbi(fixed, prior),
        "smoother": smooth(viterbi(fixed, prior), fixed, prior),
    }
    regressor = train_classical(data, opponents_training(config.training))
    for name, trajectory in regressor.trajectories(features, run, sequence.recording[run.frames], prior).items():
        label = {"classical": "classical regressor", "classical_smoothed": "classical regressor, same smoother"}[name]
        found[label] = bare(trajectory.positions_xyz, trajectory.orientations_quat_wxyz)
    two = (softmax_mean(heads_only.search(features).proba, model.bins)[:, :3], neighbours[:, :3])
    product = np.prod([positions - truth.positions_xyz for positions in two], axis=0).sum(axis=1).mean()
    common = float(np.sqrt(max(product, 0)))
    return found, bare(truth.positions_xyz, truth.orientations_quat_wxyz), seen, prior, common


def cost(seen: Observations, prior: MotionPrior) -> list[tuple[str, float, float]]:
    """Seconds and megabytes over a long recording: `seen` again and again."""
    n = len(seen.timestamps_s)
    rounds = -(-LONG // n)
    times = np.arange(rounds * n)[:LONG] / 30
    whole = range(0, LONG - n + 1, n)
    submaps = [s for start in whole for m in seen.submaps if (s := m.renumbered({f: start + f for f in range(n)}))]
    long = Observations((list(seen.candidates) * rounds)[:LONG], (list(seen.motions) * rounds)[:LONG], times, submaps)
    found = []

    def measure(name: str, work: Callable[[], PosePath | None]) -> PosePath | None:
        started = time.perf_counter()
        result = work()
        seconds = time.perf_counter() - started
        tracemalloc.start()
        work()
        peak = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        found.append((name, seconds, peak))
        return result

    def stream() -> None:
        reasoner = OnlineReasoner(prior, 10)
        for candidates, motion, timestamp in zip(long.candidates, long.motions, long.timestamps_s, strict=True):
            reasoner.push(candidates, motion, float(timestamp))

    chosen = measure("viterbi", lambda: viterbi(long, prior))
    measure("online, lag 10", stream)  # type: ignore[arg-type, func-returns-value]
    measure("smoother", lambda: smooth(chosen, long, prior))  # type: ignore[arg-type]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    rows, costs = [], []
    shared: dict[str, list[float]] = defaultdict(list)
    for place in ("corridor", "redkitchen", "redkitchen, blocks"):
        metres: dict[str, list[float]] = defaultdict(list)
        degrees: dict[str, list[float]] = defaultdict(list)
        right: dict[str, list[float]] = defaultdict(list)
        for seed in seeds:
            with tempfile.TemporaryDirectory() as scratch:
                if place == "corridor":
                    write_corridor(Path(scratch), n_modules=N_MODULES, n_laps=N_LAPS, seed=seed)
                    sequence, cache = read_sevenscenes(scratch), FeatureCache(Path(scratch) / "cache")
                    config = ModelConfig(alpha=ALPHA, seed=seed, training=replace(TRAINING, seed=seed))
                else:
                    sequence = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
                    cache = FeatureCache(default_cache_dir())
                    split = SplitKind.BLOCKS if place.endswith("blocks") else SplitKind.INTERLEAVED
                    config = ModelConfig(split=split, seed=seed, training=TrainingConfig(seed=seed))
                found, truth, seen, prior, common = methods(sequence, config, cache)
            shared[place].append(common)
            for name, path in found.items():
                off = np.linalg.norm(path.positions_xyz - truth.positions_xyz, axis=1)
                angle = angle_between_quats(path.orientations_quat_wxyz, truth.orientations_quat_wxyz)
                metres[name].append(float(np.sqrt(np.mean(off**2))))
                degrees[name].append(float(np.degrees(np.sqrt(np.mean(angle**2)))))
                right[name].append(float(np.mean(off < MODULE_LENGTH / 2)))
            if seed == seeds[0]:
                costs += [
                    (place, len(np.concatenate([c.position_log_mass for c in seen.candidates])) / len(off), c)
                    for c in cost(seen, prior)
                ]
        best = metres["best candidate (knows the truth)"]
        for name, values in metres.items():
            share = spread(right[name], 3) if place == "corridor" else ""
            ratio = spread([v / b for v, b in zip(values, best, strict=True)], 2)
            rows.append([place, name, spread(values), ratio, spread(degrees[name], 2), share])
    notes = "\n".join(
        f"- {place} ({candidates:.1f} candidate positions a frame), {LONG} frames: {name} {seconds:.1f} s, "
        f"{1e3 * seconds / LONG:.2f} ms a frame, peak {megabytes:.0f} MB."
        for place, candidates, (name, seconds, megabytes) in costs
    )
    notes = (
        "Test frames of the `interleaved` split where no other is named; median (range) over seeds "
        f"{seeds[0]} to {seeds[-1]}. Neighbours: locally linear regression among the most similar training frames. "
        f"Right mode: less than half a module ({MODULE_LENGTH / 2:.1f} m) from the truth.\n\n"
        "On redkitchen, `interleaved`, the heads' softmax mean and the neighbours, two methods that share nothing but "
        "images and training poses, have errors in common (root of the mean product) of "
        f"{spread(shared['redkitchen'])} m: noise of the poses themselves, most likely.\n\n{notes}"
    )
    header = ["data", "method", "rmse_m", "of the best candidate's", "rmse_deg", "right mode"]
    write_table(
        "reasoning", "What each part of the reasoning is worth", "python benchmarks/reasoning.py", header, rows, notes
    )


if __name__ == "__main__":
    main()
