"""What a room costs, and how exactly it is localised, alone and beside other rooms in one world.

python benchmarks/growth.py [--seeds 40] [--rooms 1 2 4 8]

The first room is redkitchen, the second fr1_desk with fr1_xyz, the others are rendered corridors with textures of their
own, all brought to one camera and 20 m apart. Each world is a process of its own, on an empty cache; numbers are kept.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch

import numpy as np
from common import DATA, REDKITCHEN, RUNS, cached_json, new_axes, parser_with_seeds, save_picture, write_table
from joblib import Parallel, delayed
from stream_row import peak_mb

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.corridor import write_corridor
from conformodal.features.extract import FeatureCache
from conformodal.geometry import pose_targets
from conformodal.io import Recording, read_recording
from conformodal.io.recording import join_recordings
from conformodal.localizer.regions import PoseRegions
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.model import ONLINE
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import train_model

APART_M = 20.0
DRAWN = {"train_cpu_s": "training, CPU", "frame_ms": "frame, CPU", "model_mb": "model", "median_mm": "median error"}
ROOMS: tuple[list[str], ...] = ([str(REDKITCHEN)], [str(DATA / "tum" / name) for name in ("fr1_desk", "fr1_xyz")])


def room(number: int, runs: Path) -> list[Recording]:
    """The recordings of a room, beside the rooms before it."""
    folders = list(ROOMS[number]) if number < len(ROOMS) else [str(runs / f"corridor-{number}")]
    if number >= len(ROOMS) and not Path(folders[0]).is_dir():
        write_corridor(folders[0], n_modules=2, n_laps=2, seed=number)
    recordings = []
    for folder in folders:
        recording = read_recording(folder)
        poses = recording.require_truth()
        moved = replace(poses, positions_xyz=poses.positions_xyz + np.array([number * APART_M, 0, 0]))
        recordings.append(replace(recording, poses=moved))
    return recordings


def measured(n_rooms: int, seed: int, runs: Path, *, only_train: bool) -> dict[str, Any]:
    """Costs of a world, errors and regions of the first room, and coverage of each room, unless only to train."""
    rooms = [room(number, runs) for number in range(n_rooms)]
    world, folder = join_recordings([one for each in rooms for one in each]), runs / f"model-{n_rooms}-{seed}"
    of_room = np.repeat(np.arange(n_rooms), [sum(map(len, each)) for each in rooms])
    if not (folder / "costs.json").is_file():
        began = time.process_time()
        model = train_model(
            world, ModelConfig(split="interleaved", seed=seed, features="xfeat"), cache=FeatureCache(None)
        )
        costs = {"train_cpu_s": time.process_time() - began, "peak_mb": peak_mb()}
        save_model(model, folder)
        (folder / "costs.json").write_text(json.dumps(costs), encoding="utf-8")
    if only_train:
        return {}
    model, costs = load_model(folder), json.loads((folder / "costs.json").read_text(encoding="utf-8"))
    began = time.process_time()
    run = VisualOdometry(model).process(world, model.split.test)
    cpu_ms = 1e3 * (time.process_time() - began) / len(run.frames)
    truth = world.require_truth()[run.frames]
    off = np.linalg.norm(run.trajectories["online"].positions_xyz - truth.positions_xyz, axis=1)
    of_room = of_room[run.frames]
    first = of_room == 0
    off = off[first]
    by_room = {
        path: coverage_by_room(regions, pose_targets(truth, model.sign_reference), of_room)
        for path, regions in {"image": run.regions, ONLINE: run.path_regions[ONLINE]}.items()
    }
    return costs | {
        "frames": len(world),
        "model_mb": sum(file.stat().st_size for file in folder.iterdir()) / 1e6,
        "frame_ms": cpu_ms,
        "median_mm": 1e3 * float(np.median(off)),
        "rmse_mm": 1e3 * float(np.sqrt((off**2).mean())),
        "length_mm": (1e3 * np.median(run.regions.length[first, :3], axis=0)).tolist(),
        "coverage": by_room["image"]["coverage"][0],
        "least": min(by_room["image"]["coverage"]),
        "least_online": min(by_room[ONLINE]["coverage"]),
        "bounded": float(np.mean(by_room["image"]["bounded"])),
        "tested": int(first.sum()),
        "by_room": by_room,
    }


def coverage_by_room(regions: PoseRegions, targets: FloatArray, of_room: IntArray) -> dict[str, list[float]]:
    """Coverage, share bounded and median length in millimetres of the regions of each room's frames."""
    held, bounded = regions.contains(targets, joint=True), ~regions.unbounded.any(axis=1)
    length_mm = 1e3 * regions.length[:, :3].mean(axis=1)
    parts = [of_room == number for number in np.unique(of_room)]
    return {
        "coverage": [float(held[part].mean()) for part in parts],
        "bounded": [float(bounded[part].mean()) for part in parts],
        "length_mm": [float(np.median(length_mm[part])) for part in parts],
    }


def draw(rooms: list[int], results: list[dict[str, Any]]) -> None:
    """Costs and error over the size of the world, in units of those in the smallest."""
    figure, axis = new_axes("growth", (5.2, 3.0))
    for key, label in DRAWN.items():
        axis.plot(rooms, [one[key] / results[0][key] for one in results], "o-", label=label)
    axis.set(xlabel="rooms", ylabel="ratio to one room", xticks=rooms, ylim=(0, None))
    axis.legend(frameon=False)
    save_picture(figure, "growth")


def main() -> None:
    parser = parser_with_seeds(__doc__, seeds=(40,))
    parser.add_argument("--rooms", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--row", action="store_true", help="measure one world in this process")
    parser.add_argument("--train", action="store_true", help="with --row: train alone")
    parser.add_argument("--workers", type=int, default=2, help="trainings at a time")
    options, runs = parser.parse_args(), RUNS / "growth"
    runs.mkdir(parents=True, exist_ok=True)
    if options.row:
        print(json.dumps(measured(options.rooms[0], options.seeds[0], runs, only_train=options.train)))
        return

    def row(n_rooms: int, seed: int, *more: str) -> Any:
        words = [sys.executable, __file__, "--row", "--rooms", str(n_rooms), "--seeds", str(seed), *more]
        finished = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True)
        return json.loads(finished.stdout.splitlines()[-1])

    def world(n: int) -> list[Any]:
        return [cached_json(runs / f"{n}-{seed}.json", partial(row, n, seed)) for seed in options.seeds]

    for number in range(max(options.rooms)):
        room(number, runs)  # is rendered once
    rows, results = [], []
    pairs = [(n, seed, "--train") for n in sorted(options.rooms, reverse=True) for seed in options.seeds]
    Parallel(options.workers, prefer="threads")(delayed(row)(*pair) for pair in pairs)
    for n, each in zip(options.rooms, map(world, options.rooms), strict=True):  # one at a time, for their times
        mean = {key: np.mean([one[key] for one in each], axis=0) for key in each[0] if key != "by_room"}
        results.append(mean)
        lengths = ", ".join(f"{value:.1f}" for value in mean["length_mm"])
        costs = [f"{mean['train_cpu_s']:.0f}", f"{mean['peak_mb']:.0f}", f"{mean['model_mb']:.0f}"]
        quality = [f"{mean['frame_ms']:.0f}", f"{mean['median_mm']:.1f}", f"{mean['rmse_mm']:.1f}", lengths]
        coverage = [f"{mean[key]:.3f}" for key in ("coverage", "least", "least_online", "bounded")]
        rows.append([str(n), f"{mean['frames']:.0f}", *costs, *quality, *coverage])
        print(rows[-1], flush=True)
    sizes = np.log([mean["frames"] for mean in results])
    slopes = {key: np.polyfit(sizes, np.log([one[key] for one in results]), 1)[0] for key in (*DRAWN, "peak_mb")}
    grown = "; ".join(f"{key} {slope:.2f}" for key, slope in slopes.items())
    note = (
        f"Split interleaved, seeds {', '.join(map(str, options.seeds))}. CPU seconds of training from images on, and "
        "peak memory. CPU per frame of a run, with reading of images. Errors online, lengths of regions in x, y and z, "
        f"and coverage are those of the first room, {results[0]['tested']:.0f} frames or so, nominal 0.90; beside them "
        "the coverage of the least covered room, by images alone and by paths, and the share of bounded regions "
        "in all rooms. Growth "
        f"with the number of frames, as exponents: {grown}."
    )
    header = ["rooms", "frames", "training, CPU s", "peak, MB", "model, MB", "frame, ms", "median, mm", "RMSE, mm"]
    header += ["length, mm", "coverage", "least covered room", "by paths", "bounded"]
    seeds, rooms = (" ".join(map(str, numbers)) for numbers in (options.seeds, options.rooms))
    command = f"python benchmarks/growth.py --seeds {seeds} --rooms {rooms}"
    draw(options.rooms, results)
    write_table("growth", "A room in a larger world", command, header, rows, note)


if __name__ == "__main__":
    main()
