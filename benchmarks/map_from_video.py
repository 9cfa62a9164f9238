"""Maps of images without poses: how right they are, what the verdict says, and a model trained on one of them.

python benchmarks/map_from_video.py [--rows fr1_desk ...]
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from common import DATA, REDKITCHEN, RUNS, cached_json, parser_of, rmse, table_lines, write_page
from scipy.spatial.transform import Rotation
from worlds import ALPHA, CACHE, DESK, RPY, XYZ, frame_by_frame, slug, summary

from conformodal.core.arrays import FloatArray
from conformodal.corridor import write_corridor
from conformodal.geometry import Trajectory, pose_targets, poses_at
from conformodal.geometry.metrics import Similarity, umeyama
from conformodal.io import Recording, read_recording
from conformodal.mapping import MapError, MapSettings, build_map
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimator import odometry_of
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import train_model

HALF, MAX_GAP_S, SEED = 0.5, 0.15, 30
COLUMNS = {
    "frames": 0, "keyframes": 0, "registered": 3, "agreeing": 3, "reprojection_px": 2, "views": 1, "loops": 0,
    "median_m": 4, "rmse_m": 4, "minutes": 1, "cpu_minutes": 1, "gb": 2,
}  # fmt: skip
MODEL_COLUMNS = {"median_m": 4, "rmse_m": 4, "bounded": 3, "positions": 3, "coverage": 3, "length_m": 3}


@dataclass(frozen=True)
class Images:
    """Images that are mapped, of a recording whose poses are known: every so many of them."""

    source: Callable[[], Recording]
    every: int = 1


def corridor() -> Recording:
    """Three identical rooms, a poster in one of them."""
    folder = RUNS / "map_from_video" / "corridor"
    if not (folder / "seq-01").is_dir():
        write_corridor(folder, n_modules=3, n_laps=1, seed=SEED)
    return read_recording(folder)


ROWS = {
    "fr1_desk": Images(partial(read_recording, DESK)),
    "redkitchen": Images(partial(read_recording, REDKITCHEN), 8),
    "icl_living_room": Images(partial(read_recording, DATA / "icl_living_room"), 4),
    "icl_living_room, far apart": Images(partial(read_recording, DATA / "icl_living_room"), 24),
    "fr1_rpy": Images(partial(read_recording, RPY), 3),
    "corridor of identical rooms": Images(corridor),
}


def map_of(name: str) -> tuple[dict[str, Any], Path]:
    """What is told of a map, and its recording; it is written although it is not to be trusted."""
    folder = RUNS / "map_from_video" / slug(name)
    images, out = folder / "images", folder / "recording"
    recording = ROWS[name].source()
    chosen = range(0, len(recording), ROWS[name].every)
    if not images.is_dir():  # files without a camera and without poses, named by their times
        images.mkdir(parents=True)
        for i in chosen:
            path = recording.image_paths[i]
            (images / f"{recording.timestamps_s[i]:.6f}{path.suffix}").symlink_to(path)
    shutil.rmtree(out, ignore_errors=True)
    began = time.process_time()
    try:
        made = build_map([images], out, settings=MapSettings(trust_map=True))
    except MapError as exc:
        return {"refused": str(exc).partition(": ")[2], "frames": len(chosen)}, out
    mapped, truth = read_recording(out, require_poses=False), recording.poses
    assert mapped.poses is not None
    assert truth is not None
    R, t, scale = similarity_of(mapped.poses, truth)
    positions = scale * mapped.poses.positions_xyz @ R.T + t
    off = np.linalg.norm(positions - poses_at(truth, mapped.poses.timestamps_s, MAX_GAP_S).rows[:, :3], axis=1)
    off = off[np.isfinite(off)]
    quality = made.quality
    numbers = {
        "frames": quality.n_frames,
        "keyframes": quality.n_keyframes,
        "registered": quality.registered,
        "agreeing": quality.agreeing,
        "reprojection_px": quality.reprojection_px,
        "views": quality.views_per_point,
        "loops": quality.n_loops,
        "median_m": float(np.median(off)),
        "rmse_m": rmse(off),
        "minutes": made.seconds / 60,
        "cpu_minutes": (time.process_time() - began) / 60,
        "gb": made.peak_bytes / 1e9,
        "verdict": "trusted" if not made.reasons else f"not trusted: {made.reasons[0].what}",
        "focal_px": made.cameras[0].fx,
        "own_focal_px": recording.camera.fx,
    }
    return numbers, out


def similarity_of(path: Trajectory, truth: Trajectory) -> Similarity:
    """From the world of a map to that of the true poses."""
    at = poses_at(truth, path.timestamps_s, MAX_GAP_S).rows
    there = np.isfinite(at).all(axis=1)
    return umeyama(path.positions_xyz[there], at[there, :3], with_scale=True)


def mount_of(path: Trajectory, truth: Trajectory, R: FloatArray) -> Rotation:
    """The turn from the camera of a map to that of the true poses: mean over all frames; `R` turns the worlds."""
    at = poses_at(truth, path.timestamps_s, MAX_GAP_S).rows
    there = np.isfinite(at).all(axis=1)
    mapped = Rotation.from_matrix(R) * Rotation.from_quat(path.orientations_quat_wxyz[there], scalar_first=True)
    return (mapped.inv() * Rotation.from_quat(at[there, 3:], scalar_first=True)).mean()


def model_on(name: str, other: Path) -> dict[str, Any]:
    """A model trained on a map answers another recording, whose true poses are brought into the world of the map."""
    mapped = read_recording(RUNS / "map_from_video" / slug(name) / "recording")
    assert mapped.poses is not None
    truth = ROWS[name].source().poses
    assert truth is not None
    R, t, scale = similarity_of(mapped.poses, truth)
    folder = RUNS / "map_from_video" / slug(name) / "model"
    if not (folder / "model.json").is_file():
        config = ModelConfig(split="blocks", alpha=ALPHA, seed=SEED, features="xfeat")
        save_model(train_model(mapped, config, cache=CACHE), folder)
    model = load_model(folder)
    new = read_recording(other)
    assert new.poses is not None
    inside = new.poses.poses_se3
    mount = mount_of(mapped.poses, truth, R)
    inside[:, :3, :3] = R.T @ inside[:, :3, :3] @ mount.inv().as_matrix()
    inside[:, :3, 3] = (inside[:, :3, 3] - t) @ R / scale
    poses = Trajectory.from_poses_se3(new.poses.timestamps_s, inside)
    answered = replace(new, camera=mapped.camera, poses=poses, unit=mapped.unit)  # taken by the camera of the map
    run = odometry_of(model).process(answered, answered.posed)
    laboratory: Any = SimpleNamespace(truth=lambda run: poses[np.searchsorted(answered.posed, run.frames)])
    frames = frame_by_frame(laboratory, run)
    numbers = {key: summary(each) for key, each in frames.items()}
    targets = pose_targets(poses[np.searchsorted(answered.posed, run.frames)], model.sign_reference)
    for key, regions in {"image alone": run.regions, **run.path_regions}.items():
        numbers[key]["positions"] = float(regions.contains(targets)[:, :3].all(axis=1).mean())
    numbers["image alone"]["mount_deg"] = float(np.degrees(mount.magnitude()))
    for each in numbers.values():  # metres
        each |= {key: scale * value for key, value in each.items() if key.endswith("_m")}
    return numbers


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=ROWS)
    names = parser.parse_args().rows
    kept = RUNS / "map_from_video"
    maps = {name: cached_json(kept / f"{slug(name)}.json", lambda name=name: map_of(name)[0]) for name in names}
    rows = []
    for name, numbers in maps.items():
        cells = [f"{numbers[key]:.{digits}f}" if key in numbers else "" for key, digits in COLUMNS.items()]
        rows.append([name, *cells, numbers.get("verdict") or f"refused: {numbers['refused']}"])
    blocks: list[str | list[str]] = [
        "## Maps",
        "Images of known recordings, given as a folder of images without poses and without a camera: all of fr1_desk "
        "and of the corridor, every 8th of redkitchen, every 4th of icl_living_room and, far apart, every 24th, every "
        "3rd of fr1_rpy. Registered: share of the frames; agreeing: share of the pairs of keyframes whose matches lie "
        "near the epipolar lines of the map; loops: agreeing pairs that are not neighbours in time; errors: of "
        "positions, after a similarity to the true ones; minutes: wall time beside other work on the machine, and CPU "
        "time; gb: most memory of the process until then. Maps that are not trusted are measured all the same.",
        table_lines(["images", *COLUMNS, "verdict"], rows),
    ]
    if "fr1_desk" in maps:
        focal = (
            f"{maps['fr1_desk']['focal_px']:.0f} px where the published one is {maps['fr1_desk']['own_focal_px']:.0f}"
        )
        model = cached_json(kept / "model.json", partial(model_on, "fr1_desk", XYZ))
        mount_deg = model["image alone"]["mount_deg"]
        cells = [
            [name, *(f"{one[key]:.{d}f}" if key in one else "" for key, d in MODEL_COLUMNS.items())]
            for name, one in model.items()
        ]
        blocks += [
            "## A model of a map",
            f"Trained on the map of fr1_desk with default settings (seed {SEED}, alpha = {ALPHA}), it answers all "
            "frames of fr1_xyz with a pose, as images of the map's camera. The true poses are brought into the world "
            "of the map by the similarity of the positions of fr1_desk, and their cameras turned by the mean "
            f"difference there, {mount_deg:.1f} degrees, of motion capture's camera from the map's. The focal length "
            f"is {focal}. Positions: share that the regions hold in x, y and z; coverage: whole poses, unbounded "
            "regions included; length: median of the mean along x, y and z.",
            table_lines(["from", *MODEL_COLUMNS], cells),
        ]
    command = "python benchmarks/map_from_video.py" + (
        "" if names == list(ROWS) else f" --rows {' '.join(map(repr, names))}"
    )
    write_page("map_from_video", "Maps of images without poses", command, *blocks)


if __name__ == "__main__":
    main()
