"""A map that grows: cost and quality beside training from scratch, and coverage by recordings in a simulation.

python benchmarks/extend.py [--orders 6] [--simulated 1000]    # --orders 0: the simulation alone

In each order of TUM freiburg1's three recordings, a model of the first, extended by the second, answers the third,
beside a model that was trained on the first two. Each training and extension is measured once, and kept.
"""

from __future__ import annotations

import json
import os
import time
import warnings
from functools import partial
from itertools import permutations
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from common import DATA, RUNS, cached_json, parser_with_seeds, table_lines, write_page
from scipy.spatial import KDTree

from conformodal.conformal import conformal_quantile, conformal_rank, hierarchical_quantile
from conformodal.core.arrays import FloatArray, IntArray
from conformodal.features.extract import FeatureCache
from conformodal.geometry import pose_targets
from conformodal.io import DatasetWarning, Recording, read_recording
from conformodal.pipeline.config import ModelConfig, OdometryError
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.extend import extend_model
from conformodal.pipeline.model import ONLINE
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import train_model

FR1 = ("fr1_desk", "fr1_xyz", "fr1_rpy")
KEPT, ALPHA = RUNS / "extend", 0.1
N_RECORDINGS, N_FRAMES, N_BASE = 30, 20, 2


# ---- real recordings


def recording(name: str) -> Recording:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DatasetWarning)
        return read_recording(DATA / "tum" / name)


def trained(names: tuple[str, ...], seed: int) -> dict[str, float]:
    """Train on recordings from images on and keep the model; CPU seconds."""

    def measure() -> dict[str, float]:
        began = time.process_time()
        config = ModelConfig(split="blocks", seed=seed, features="xfeat")
        model = train_model([recording(name) for name in names], config, cache=FeatureCache(None))
        seconds = time.process_time() - began
        save_model(model, KEPT / f"{'+'.join(names)}-{seed}")
        return {"cpu_s": seconds}

    return cached_json(KEPT / f"{'+'.join(names)}-{seed}.json", measure)


def extended(first: str, second: str, seed: int) -> dict[str, Any]:
    """Extend the model of one recording by another and keep it; CPU seconds, and how the second was answered before.

    Or why the second is refused.
    """

    def measure() -> dict[str, Any]:
        model = load_model(KEPT / f"{first}-{seed}")
        began = time.process_time()
        try:
            grown = extend_model(model, [recording(second)])
        except OdometryError as exc:
            return {"refused": str(exc)}
        seconds = time.process_time() - began
        save_model(grown, KEPT / f"{first}, then {second}-{seed}")
        [entry] = grown.journal
        return {"cpu_s": seconds, "coverage": entry.coverage, "median_m": entry.median_m}

    return cached_json(KEPT / f"{first}, then {second}-{seed}.json", measure)


def answered(model_name: str, third: str, seed: int) -> dict[str, float]:
    """Errors and regions of a kept model on a recording."""

    def measure() -> dict[str, float]:
        model, data = load_model(KEPT / f"{model_name}-{seed}"), recording(third)
        run = VisualOdometry(model).process(data)
        truth = data.require_truth()[run.frames]
        targets = pose_targets(truth, model.sign_reference)
        off = np.linalg.norm(run.trajectories[ONLINE].positions_xyz - truth.positions_xyz, axis=1)
        numbers = {"median_m": float(np.median(off)), "rmse_m": float(np.sqrt((off**2).mean()))}
        for path, regions in {"image": run.regions, ONLINE: run.path_regions[ONLINE]}.items():
            held, bounded = regions.contains(targets, joint=True), ~regions.unbounded.any(axis=1)
            length = np.median(regions.length[bounded][:, :3].mean(axis=1)) if bounded.any() else np.nan
            numbers |= {f"{path}_coverage": float(held.mean()), f"{path}_bounded": float(bounded.mean())}
            numbers[f"{path}_length_m"] = float(length)
        return numbers

    return cached_json(KEPT / f"{model_name} on {third}-{seed}.json", measure)


def order_rows(order: tuple[str, ...], seed: int) -> list[list[str]]:
    """The rows of an order: the model that was extended, and the one that was trained on both."""
    first, second, third = order
    both = tuple(name for name in FR1 if name in (first, second))
    trained((first,), seed)
    grown = extended(first, second, seed)
    if "refused" in grown:
        return [[third, f"{first}, extended by {second}: refused, {grown['refused']}", *[""] * 9]]
    whole = trained(both, seed)
    rows, measured = [], {}
    for name, label, seconds in (
        (f"{first}, then {second}", f"{first}, extended by {second}", grown["cpu_s"]),
        ("+".join(both), f"{first} and {second}, trained", whole["cpu_s"]),
    ):
        one = measured[label] = answered(name, third, seed)
        cells = [f"{1e3 * one[key]:.1f}" for key in ("median_m", "rmse_m", "image_length_m", f"{ONLINE}_length_m")]
        shares = [f"{one[f'{path}_{key}']:.3f}" for path in ("image", ONLINE) for key in ("coverage", "bounded")]
        rows.append([third, label, f"{seconds:.0f}", *cells, *shares])
        print(rows[-1], flush=True)
    a, b = measured.values()
    ratios = [a[key] / b[key] for key in ("median_m", "rmse_m", "image_length_m", f"{ONLINE}_length_m")]
    rows.append([third, "ratio", f"{grown['cpu_s'] / whole['cpu_s']:.2f}", *(f"{r:.2f}" for r in ratios), *[""] * 4])
    return rows


# ---- a simulation


class World(NamedTuple):
    """Recordings in a square: what a camera sees is a smooth function of its position, and a little of the day."""

    places: FloatArray  # (r, m, 2)
    looks: FloatArray  # (r, m, 8)


def world(n: int, random: np.random.Generator) -> World:
    """Recordings of frames along random ways."""
    start, heading = random.uniform(0, 1, (n, 1, 2)), random.uniform(0, 2 * np.pi, (n, 1))
    headings = heading + np.cumsum(random.normal(0, 0.4, (n, N_FRAMES)), axis=1)
    steps = 0.03 * np.stack((np.cos(headings), np.sin(headings)), axis=2)
    places = np.mod(start + np.cumsum(steps, axis=1), 2)
    places = np.minimum(places, 2 - places)  # reflected at the walls
    waves = np.random.default_rng(1).normal(0, 3, (2, 8))
    day, noise = random.normal(0, 0.1, (n, 1, 8)), random.normal(0, 0.05, (n, N_FRAMES, 8))
    return World(places, np.sin(places @ waves + np.arange(8)) + day + noise)


def errors(known: IntArray, asked: int, seen: World) -> FloatArray:
    """Errors (m,) of a recording's frames: positions are the mean of the three frames that look most alike."""
    looks, places = seen.looks[known].reshape(-1, 8), seen.places[known].reshape(-1, 2)
    _, near = KDTree(looks).query(seen.looks[asked], 3)
    return np.asarray(np.linalg.norm(places[near].mean(axis=1) - seen.places[asked], axis=1))


def simulated(n_orders: int, seed: int) -> dict[str, Any]:
    """Coverage of the last of so many recordings, by threshold and learner; means over orders and standard errors."""
    sizes = (9, 19, 29)
    held: dict[str, list[float]] = {f"{kind} {n}": [] for kind in ("fixed", "frame", "growing") for n in sizes}
    for number in range(n_orders):
        random = np.random.default_rng((seed, number))
        seen = world(N_BASE + N_RECORDINGS, random)
        base = np.arange(N_BASE)
        fixed = [errors(base, N_BASE + k, seen) for k in range(N_RECORDINGS)]
        grown = [errors(np.arange(N_BASE + k), N_BASE + k, seen) for k in range(N_RECORDINGS)]
        drawn = np.array([random.choice(scores) for scores in fixed])
        for n in sizes:
            held[f"fixed {n}"].append(float((fixed[n] <= hierarchical_quantile(fixed[:n], ALPHA)).mean()))
            held[f"growing {n}"].append(float((grown[n] <= hierarchical_quantile(grown[:n], ALPHA)).mean()))
            held[f"frame {n}"].append(float(drawn[n] <= conformal_quantile(drawn[:n], ALPHA)))
    return {name: [float(np.mean(each)), float(np.std(each) / np.sqrt(len(each)))] for name, each in held.items()}


def simulation_table(n_orders: int, seed: int) -> list[str]:
    numbers = cached_json(KEPT / f"simulated-{n_orders}-{seed}.json", partial(simulated, n_orders, seed))
    rows = []
    for kind, label in (
        ("frame", "fixed map, one random frame of each recording"),
        ("fixed", "fixed map, all frames"),
        ("growing", "growing map, all frames"),
    ):
        for n in (9, 19, 29):
            mean, error = numbers[f"{kind} {n}"]
            law = f"{conformal_rank(n, ALPHA) / (n + 1):.3f}" if kind == "frame" else f"at least {1 - ALPHA:.2f}"
            rows.append([label, str(n), f"{mean:.3f} ± {2.576 * error:.3f}", law])
    return table_lines(["scores", "recordings that calibrate", "coverage of the next one", "law"], rows)


def beside_scratch(orders: list[tuple[str, ...]], seed: int) -> list[str | list[str]]:
    """The table of some orders, and a note."""
    rows = [row for order in orders for row in order_rows(order, seed)]
    kept = [file for file in sorted(KEPT.glob(f"*, then *-{seed}.json")) if " on " not in file.name]
    tests = [one for one in (json.loads(file.read_text(encoding="utf-8")) for file in kept) if "coverage" in one]
    header = ["answered", "model", "CPU s", "median, mm", "RMSE, mm", "length, mm", "length by path, mm"]
    header += ["coverage", "bounded", "coverage by path", "bounded by path"]
    note = (
        f"Split blocks, seed {seed}, defaults, alpha {ALPHA}; CPU seconds from images on, without a cache, of the "
        "extension alone or of the whole training. The extended model learns from all of the second recording, the "
        "trained one from 80 % of both. Positions online; lengths: median of the mean of x, y and z where bounded. "
        f"Before it joined, the second recording was covered in {min(one['coverage'] for one in tests):.3f} to "
        f"{max(one['coverage'] for one in tests):.3f}. Nothing is guaranteed for another recording here: stretches "
        "calibrate."
    )
    return [table_lines(header, rows), note]


def main() -> None:
    parser = parser_with_seeds(__doc__, seeds=(40,))
    parser.add_argument("--orders", type=int, default=6, help="of the recordings")
    parser.add_argument("--simulated", type=int, default=1000, help="orders of simulated recordings")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    seed = options.seeds[0]
    table = simulation_table(options.simulated, seed)
    print("\n".join(table), flush=True)
    blocks: list[str | list[str]] = []
    if orders := list(permutations(FR1))[: options.orders]:
        blocks = ["## Beside training from scratch", *beside_scratch(orders, seed)]
    about = (
        f"{options.simulated} simulated orders of {N_RECORDINGS} recordings with {N_FRAMES} frames after {N_BASE} that "
        "are mapped at first; a map is a nearest-neighbour regression. Each recording is scored by the map before it. "
        "With a fixed map, coverage of one random frame follows an exact law. With a growing map the scores of earlier "
        "recordings are larger, so that thresholds are too large rather than too small. Means with 99 % intervals."
    )
    command = f"python benchmarks/extend.py --orders {options.orders} --simulated {options.simulated}"
    write_page("extend", "A map that grows", command, *blocks, "## Coverage", table, about)


if __name__ == "__main__":
    main()
