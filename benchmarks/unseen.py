"""What a model says where it has not been: new parts of a scene, other scenes, disturbed images, moved furniture.

python benchmarks/unseen.py [--seed 40]     # also draws redkitchen `blocks`
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from common import (
    DATA,
    REDKITCHEN,
    RUNS,
    SEEDS,
    cached_json,
    new_axes,
    parser_of,
    part_of,
    rmse,
    save_picture,
    table_lines,
    write_page,
)
from PIL import Image
from worlds import ALPHA, CACHE, N_LAPS, N_MODULES, TRAINING

from conformodal.corridor import CorridorWorld, Renderer, drone_path, write_corridor, write_flight
from conformodal.features.extract import FeatureCache
from conformodal.geometry import pose_targets
from conformodal.io import PixelNoise, Recording, SplitKind, read_image, read_recording
from conformodal.localizer.regions import LEVEL_STRETCHES
from conformodal.pipeline.config import Calibration, ModelConfig
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.train import prepare_training_data, train_model

KNOWN_SHARE = 0.6
N_FLIGHT = 240  # frames of a flight
NEW_FLIGHT, WING = "new flight through known rooms", "unseen: a wing with other walls and floors"
FURNITURE = "furniture moved"
KNOWN, REST = "known place: the test part", "unseen: the rest of the recording"

Images = Callable[[np.ndarray, int], np.ndarray]
DISTURBED: dict[str, Images] = {
    "dark": lambda image, _: (image * 0.12).astype(np.uint8),
    "blurred, 5 px": lambda image, _: cv2.GaussianBlur(image, (0, 0), 5.0),
    "lens covered": lambda image, i: np.random.default_rng(i).integers(0, 6, image.shape, dtype=np.uint8),
    "noise 0.05": lambda image, i: PixelNoise(0.05).apply(image, str(i)),
    "noise 0.1": lambda image, i: PixelNoise(0.1).apply(image, str(i)),
    "noise 0.2": lambda image, i: PixelNoise(0.2).apply(image, str(i)),
    "colours shifted": lambda image, _: np.clip(image * np.array([1.3, 0.95, 0.6]), 0, 255).astype(np.uint8),
    "upside down": lambda image, _: np.ascontiguousarray(image[::-1, ::-1]),
}


def changed(sequence: Recording, frames: np.ndarray, change: Images, folder: Path) -> Recording:
    """Some frames of a sequence, their images changed and written to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i in frames.tolist():
        paths.append(folder / f"frame-{i:06d}.png")
        Image.fromarray(change(read_image(sequence.image_paths[i]), i)).save(paths[-1], compress_level=1)
    return replace(part_of(sequence, frames, name=folder.name), image_paths=tuple(paths))


def trained(sequence: Recording, split: str, calibration: str, seed: int, cache: FeatureCache, **how: Any) -> PoseModel:
    chosen = {"split": SplitKind(split), "calibrate_on": Calibration(calibration)}
    config = ModelConfig(seed=seed, alpha=ALPHA, **chosen, **how)
    return train_model(prepare_training_data(sequence, config, cache), config)


def measured(model: PoseModel, sequence: Recording, frames: np.ndarray | None = None) -> dict[str, Any]:
    """Numbers of one run; lists over frames are stored, so that seeds can be put together."""
    run = VisualOdometry(model).process(replace(sequence, camera=model.camera), frames)
    unbounded = run.regions.unbounded.any(axis=1)
    numbers: dict[str, Any] = {
        "frames": len(run.frames),
        "abstained": unbounded.tolist(),
        "flagged": (~run.reliable).tolist(),
        "known_p": np.round(run.known_p, 4).tolist(),
        "length_m": np.where(unbounded, np.nan, run.regions.length[:, :3].mean(axis=1)).tolist(),
    }
    if sequence.truth is None:
        return numbers
    truth = sequence.truth[run.frames]
    held = run.regions.contains(pose_targets(truth, model.sign_reference), joint=True)
    off = np.linalg.norm(run.trajectory.positions_xyz - truth.positions_xyz, axis=1)
    return {**numbers, "covered": (held | unbounded).tolist(), "off_m": off.tolist()}


def foreign(scratch: Path) -> Iterator[tuple[str, Recording]]:
    """Frames of other data sets, brought to the model's size, without poses in its world."""
    fit = partial(cv2.resize, dsize=(640, 480), interpolation=cv2.INTER_AREA)
    folders = {"TUM fr3 cabinet": DATA / "tum" / "fr3_cabinet", "KITTI 06": DATA / "kitti" / "sequences" / "06"}
    for name, folder in folders.items():
        other = read_recording(folder)
        images = changed(other, np.arange(len(other)), lambda image, _: fit(image), scratch / name)
        yield name, replace(images, poses=None)


def redkitchen(seed: int, cache: FeatureCache, scratch: Path) -> dict[str, Any]:
    video = read_recording(REDKITCHEN)
    every = np.arange(len(video))
    mapped, rest = np.split(every, [int(KNOWN_SHARE * len(video))])
    runs: dict[str, Any] = {}
    for split, calibration in (("interleaved", "frames"), ("blocks", "stretches")):
        sequence = part_of(video, mapped, name=f"redkitchen, first {KNOWN_SHARE:.0%}")
        model = trained(sequence, split, calibration, seed, cache, features="xfeat")
        test = model.split.test
        rows = {KNOWN: measured(model, sequence, test), REST: measured(model, part_of(video, rest, name="rest"))}
        for name, other in foreign(scratch):
            rows[f"another data set: {name}"] = measured(model, other)
        for name, change in DISTURBED.items():
            there = changed(sequence, test, change, scratch / f"{split}{seed}" / name)
            rows[f"test part, {name}"] = measured(model, there)
        runs[f"{split}, {calibration}"] = rows
    return runs


def corridor_flights(seed: int, scratch: Path) -> tuple[Recording, dict[str, Recording]]:
    """The known corridor, and flights that nobody trained on: known rooms, an unknown wing, other furniture."""
    world = CorridorWorld(N_MODULES, seed=seed)
    sequence = read_recording(write_corridor(scratch / "known", n_modules=N_MODULES, n_laps=N_LAPS, seed=seed))
    path = drone_path(world, 1, seed=1000 + seed).poses_se3
    start = int(np.random.default_rng(seed).integers(len(path) - N_FLIGHT))
    flight = path[start : start + N_FLIGHT]
    renderers = {
        NEW_FLIGHT: Renderer(world),
        WING: Renderer(CorridorWorld(N_MODULES, seed=seed + 50)),
        FURNITURE: Renderer(CorridorWorld(N_MODULES, seed=seed, rearranged=True)),
    }
    flights = {}
    for number, (name, renderer) in enumerate(renderers.items()):
        folder = write_flight(scratch / f"flight{number}" / "seq-01", renderer, flight, noise_seed=(1 + number) * 10**6)
        flights[name] = read_recording(folder.parent)
    truth = flights[WING].require_truth()
    behind = np.array([world.length, 0.0, 0.0])  # the wing lies behind the end of the hall
    flights[WING] = replace(flights[WING], poses=replace(truth, positions_xyz=truth.positions_xyz + behind))
    return sequence, flights


def corridor(seed: int, cache: FeatureCache, scratch: Path) -> dict[str, Any]:
    sequence, flights = corridor_flights(seed, scratch)
    model = trained(sequence, "interleaved", "frames", seed, cache, training=replace(TRAINING, seed=seed))
    rows = {KNOWN: measured(model, sequence, model.split.test[:N_FLIGHT])}
    rows |= {name: measured(model, flight) for name, flight in flights.items()}
    return {"interleaved, frames": rows}


COLUMNS = [
    "whole pose covered", "abstained", "length of other regions, m",
    "flagged", "not flagged: median error, m", "within 0.3 m", "RMSE of all, m",
]  # fmt: skip


def columns_of(run: dict[str, Any]) -> dict[str, str]:
    """Cells of a row by their column."""
    lengths, flagged = np.array(run["length_m"], dtype=float), np.array(run["flagged"])
    bounded = lengths[np.isfinite(lengths)]
    cells = {
        "abstained": f"{np.mean(run['abstained']):.3f}",
        "length of other regions, m": f"{bounded.mean():.3f}" if len(bounded) else "-",
        "flagged": f"{flagged.mean():.3f}",
    }
    if "covered" not in run:  # no poses in the model's world
        return cells
    off = np.array(run["off_m"])
    if len(unflagged := off[~flagged]):
        cells["not flagged: median error, m"] = f"{np.median(unflagged):.4f}"
        cells["within 0.3 m"] = f"{np.mean(unflagged < 0.3):.3f}"
    return cells | {"whole pose covered": f"{np.mean(run['covered']):.3f}", "RMSE of all, m": f"{rmse(off):.4f}"}


def table(results: dict[str, Any]) -> list[str]:
    """Rows of all worlds."""
    lines = []
    for world, by_split in results.items():
        for how, runs in by_split.items():
            for name, run in runs.items():
                cells = columns_of(run)
                lines.append([world, how, name, str(run["frames"]), *(cells.get(column, "") for column in COLUMNS)])
    return table_lines(["world", "split, calibration", "frames", "n", *COLUMNS], lines)


def draw(runs: dict[str, Any]) -> None:
    """p-values and errors where the camera has been and where it has not."""
    blue, red = "#2166ac", "#b2182b"
    figure, (above, below) = new_axes("unseen", (7.2, 3.8), rows=2)
    start = 0
    for name, label in ((KNOWN, "known places, held out"), (REST, "places never seen")):
        run = runs[name]
        at, flagged = np.arange(start, start + run["frames"]), np.array(run["flagged"])
        for axis, values in ((above, np.array(run["known_p"])), (below, np.array(run["off_m"]))):
            axis.plot(at[~flagged], values[~flagged], ".", ms=3, color=blue)
            axis.plot(at[flagged], values[flagged], ".", ms=3, color=red)
            if start:
                axis.axvline(start - 0.5, color="black", lw=0.8)
        above.text(at.mean(), 1.25, label, ha="center", va="bottom")
        start = at[-1] + 1
    above.axhline(LEVEL_STRETCHES, color=red, lw=0.8, ls="--")
    legend = "at or below the line, unless a place is recognised,\nthe region is unbounded"
    above.text(2, 0.019, legend, color=red, va="bottom", fontsize=8)
    above.set(yscale="log", ylim=(0.017, 1.2), ylabel="p-value: known?")
    below.set(yscale="log", ylabel="error (m)", xlabel="answered frame", xlim=(0, start))
    below.plot([], [], ".", color=blue, label="reliable")
    below.plot([], [], ".", color=red, label="flagged: like no place that is known")
    below.legend(loc="lower right", frameon=False, ncols=2)
    save_picture(figure, "unseen")


def all_runs(world: str, seed: int, cache: FeatureCache) -> dict[str, Any]:
    """The numbers of a world and a seed."""
    with tempfile.TemporaryDirectory() as scratch:
        return {"redkitchen": redkitchen, "corridor": corridor}[world](seed, cache, Path(scratch))


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=SEEDS[0])
    seed = parser.parse_args().seed
    results = {
        world: cached_json(RUNS / "unseen" / f"{world}-{seed}.json", partial(all_runs, world, seed, CACHE))
        for world in ("redkitchen", "corridor")
    }
    draw(results["redkitchen"]["blocks, stretches"])
    note = (
        f"alpha = {ALPHA}; seed {seed}. redkitchen: the first {KNOWN_SHARE:.0%} of the recording are known and cut "
        "into training, calibration and test part; disturbances change the test part. Corridor: a flight of "
        f"{N_FLIGHT} frames that nobody trained on. An unbounded region counts as covered and as abstained. Nothing is "
        "guaranteed where frames are not exchangeable with those that calibrated (all rows but the test part of "
        "`interleaved`); settings were chosen on redkitchen and corridors with seeds 10 to 29. Flagged: `reliable` is "
        "False."
    )
    title, command = "Where the camera has never been", f"python benchmarks/unseen.py --seed {seed}"
    write_page("unseen", title, command, table(results), note)


if __name__ == "__main__":
    main()
