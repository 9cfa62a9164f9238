"""Map one recording, answer another: TUM freiburg1, from fr1_desk to fr1_xyz and back.

python benchmarks/recordings.py [--seed 10] [--runs FOLDER]
python benchmarks/recordings.py --draw     # the picture of README: fr1_xyz, answered with a map of fr1_desk

Ours, the paper's system, and pycolmap. Its numbers are kept as ours are; to measure them anew, delete those in
benchmarks/results/recordings and install benchmarks/peers/recordings.txt.
"""

from __future__ import annotations

import json
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, RESULTS, ROOT, cached_json, new_axes, parser_of, rmse, save_picture, table_lines, write_page
from scipy.stats import chi2

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.features.extract import FeatureCache
from conformodal.io import Recording, SplitKind, read_recording
from conformodal.localizer.candidates import pose_targets
from conformodal.localizer.overlap import near_known
from conformodal.pipeline.config import Method, ModelConfig
from conformodal.pipeline.estimates import OdometryRun
from conformodal.pipeline.estimator import odometry_of
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model

PAIRS = (("fr1_desk", "fr1_xyz"), ("fr1_xyz", "fr1_desk"))
NEAR_M, NEAR_RAD, ALPHA = 0.3, np.radians(30.0), 0.1
SYSTEMS = {Method.CONFORMODAL: "ours", Method.PAPER: "the paper's"}
PEER = "pycolmap, poses refined"
TIMED, FAR_M = 60, 0.3  # frames whose time is taken; a large error
SHOWN = (  # in the picture
    ("conformodal", "online", "ours: regions", "#2166ac"),
    ("pycolmap", PEER, "pycolmap: ellipsoids", "#b2182b"),
)
MOST_ASKED = 100  # images that the peer answers, evenly spread


def _sequences(source: str, target: str) -> tuple[Recording, Recording, BoolArray]:
    """Both recordings, and which posed frames of the second lie near a frame of the first."""
    mapped, new = (read_recording(DATA / "tum" / name) for name in (source, target))
    near = near_known(new.poses, mapped.require_truth(), NEAR_M, NEAR_RAD)
    return mapped, new, near


def measured(source: str, target: str, seed: int, runs: Path, method: Method) -> dict[str, dict[str, float]]:
    """Numbers of the frames of `target` that lie near a frame of `source`, by what regions and poses rest on.

    The paper's system is calibrated as the paper says: on random frames of the training recording.
    """
    folder = runs / f"{source}-{seed}-{method}"
    mapped, new, near = _sequences(source, target)
    if not (folder / "model.json").is_file():
        make = ModelConfig.paper if method is Method.PAPER else ModelConfig
        config, began = make(split=SplitKind.BLOCKS, seed=seed, alpha=ALPHA), time.process_time()
        save_model(train_model(prepare_training_data(mapped, config, FeatureCache(None)), config), folder)
        folder.with_suffix(".seconds").write_text(f"{time.process_time() - began}")
    model, answered = load_model(folder), new.posed
    run = odometry_of(model).process(new, answered)
    truth, near = new.poses[np.searchsorted(answered, run.frames)], near[np.searchsorted(answered, run.frames)]
    targets, numbers, drawn = pose_targets(truth, model.sign_reference), {}, {}
    regions = {"image alone": run.regions, **run.path_regions}
    alone = np.array([e.candidates.positions_xyz[np.argmax(e.candidates.log_mass)] for e in run.estimates])
    for name, positions in {"image alone": alone, **{k: t.positions_xyz for k, t in run.trajectories.items()}}.items():
        off = np.linalg.norm(positions - truth.positions_xyz, axis=1)[near]
        numbers[name] = _errors(off)
        if name in regions:
            bounded = ~regions[name].unbounded.any(axis=1) & near
            held, each = regions[name].contains(targets, joint=True), regions[name].contains(targets)
            lengths = regions[name].length[:, :3].mean(axis=1)
            numbers[name] |= {
                "unbounded": float(1 - bounded.sum() / near.sum()),
                "coverage": float(held[bounded].mean()),
                "length_m": float(np.median(lengths[bounded])),
                "localised": float(bounded.sum() / near.sum()),
                "position_held": float(each[bounded, :3].all(axis=1).mean()),
            }
            drawn[name] = {"off_m": off.tolist(), "length_m": np.where(bounded, lengths, np.nan)[near].tolist()}
    numbers[run.answer]["reliable"] = float(run.reliable[near].mean())
    (runs / f"{target}-{method}.json").write_text(json.dumps(drawn))
    costs = {
        "ms": _ms_per_frame(model, new, run, near),
        "map_s": float(folder.with_suffix(".seconds").read_text()),
        "mb": sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6,
    }
    return numbers | {"frames": {"near": int(near.sum()), "all": len(near)}, "costs": costs}


def _errors(off: FloatArray) -> dict[str, float]:
    return {
        "rmse_m": rmse(off),
        "median_m": float(np.median(off)),
        "far": float(np.mean(off > FAR_M)),
    }


def _ms_per_frame(model: Any, new: Recording, run: OdometryRun, near: BoolArray) -> float:
    """CPU time of a frame of a stream, without reading the image, over the first frames near known ones."""
    odometry, spent = odometry_of(model), []
    for i in run.frames[near][:TIMED].tolist():
        image, began = new.image(i), time.process_time()
        odometry.step(image, new.timestamps_s[i])
        spent.append(time.process_time() - began)
    return 1e3 * float(np.mean(spent))


def measured_peer(source: str, target: str, runs: Path) -> dict[str, dict[str, float]]:
    """The same numbers of pycolmap on the same frames; its errors are those of the images that it localises."""
    from recordings_peer import answers, build_map  # noqa: PLC0415 - pycolmap

    mapped, new, near = _sequences(source, target)
    rows = np.flatnonzero(near)
    rows = rows[:: -(-len(rows) // MOST_ASKED)]
    peer = build_map(mapped, runs / f"{source}-pycolmap")
    answer = answers(peer, new, new.posed[rows])
    error, ok = answer.positions_xyz - new.poses.positions_xyz[rows], np.isfinite(answer.positions_xyz[:, 0])
    inverse, bound = np.linalg.inv(answer.covariances[ok]), chi2.ppf(1 - ALPHA, 3)
    lengths = 2 * np.sqrt(bound * np.einsum("naa->na", answer.covariances)).mean(axis=1)
    numbers = _errors(np.linalg.norm(error[ok], axis=1)) | {
        "localised": float(ok.mean()),
        "position_held": float(np.mean(np.einsum("na,nab,nb->n", error[ok], inverse, error[ok]) < bound)),
        "length_m": float(np.median(lengths[ok])),
        "ms": float(answer.ms.mean()),
        "map_s": float(peer.seconds),
        "mb": peer.megabytes,
    }
    drawn = {"off_m": np.linalg.norm(error, axis=1).tolist(), "length_m": lengths.tolist()}
    (runs / f"{target}-pycolmap.json").write_text(json.dumps({PEER: drawn}))
    return {PEER: numbers}


def draw(runs: Path) -> None:
    """Errors over stated uncertainties, ours and the peer's."""
    figure, axis = new_axes("recordings", (7.2, 3.0))
    for file, name, label, colour in SHOWN:
        frames = json.loads((runs / f"fr1_xyz-{file}.json").read_text())[name]
        off, half = np.array(frames["off_m"], float), np.array(frames["length_m"], float) / 2
        axis.plot(half, off, ".", ms=4, color=colour, label=label)
    low, high = 3e-4, 1.0
    axis.plot([low, high], [low, high], color="black", lw=0.8)
    axis.text(0.0004, 0.4, "error above the stated one", fontsize=8)
    axis.set(xscale="log", yscale="log", xlim=(low, high), ylim=(low, high))
    axis.set(xlabel="stated: half the length at 0.9, mean over x, y, z (m)", ylabel="error of the position (m)")
    axis.legend(loc="lower right", frameon=False)
    save_picture(figure, "recordings")


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=10)
    parser.add_argument("--runs", type=Path, default=ROOT / "recordings-out")
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    if options.draw:
        draw(options.runs)
        return
    options.runs.mkdir(parents=True, exist_ok=True)
    columns = ("rmse_m", "median_m", "unbounded", "coverage", "length_m", "reliable")
    beside = ("median_m", "rmse_m", "far", "localised", "position_held", "length_m", "ms", "map_s", "mb")
    digits = {"rmse_m": 4, "median_m": 4, "ms": 0, "map_s": 0, "mb": 1}
    rows, peers = [], []

    def cells(row: dict[str, float], names: tuple[str, ...]) -> list[str]:
        return [f"{row[key]:.{digits.get(key, 3)}f}" if key in row else "" for key in names]

    for source, target in PAIRS:
        for method, system in SYSTEMS.items():
            file = RESULTS / "recordings" / f"{source}-{options.seed}-{method}.json"
            results = cached_json(file, partial(measured, source, target, options.seed, options.runs, method))
            frames, costs = results.pop("frames"), results.pop("costs", {})
            shown = f"{target} from {source}, {frames['near']} of {frames['all']} frames"
            rows += [[shown, system, name, *cells(row, columns)] for name, row in results.items()]
            if method is Method.CONFORMODAL:
                peers += [[shown, f"ours, {name}", *cells(row | costs, beside)] for name, row in results.items()]
        file = RESULTS / "recordings" / f"{source}-pycolmap.json"
        results = cached_json(file, partial(measured_peer, source, target, options.runs))
        peers += [[shown, name, *cells(row, beside)] for name, row in results.items()]
    note = (
        f"Frames with a known view within {NEAR_M} m and 30 degrees. Split `blocks`, seed {options.seed}, "
        f"alpha {ALPHA}: stretches of the mapped recording calibrate, so nothing is guaranteed for another recording. "
        "Coverage is that of bounded regions, of the whole pose; the paper asks 0.9 of each target. Length is the "
        "median over frames of the mean along x, y and z."
    )
    peer_note = (
        f"pycolmap 4.2.1 with SIFT on the same frames, at most {MOST_ASKED} evenly spread ones, each image alone "
        "(benchmarks/recordings_peer.py; the map takes every third image). Errors are "
        f"over all frames for ours, and over those that it localises for pycolmap; far: off by more than {FAR_M} m. "
        "Localised: with a bounded region, or with a pose. Held: true positions in our regions, or in the ellipsoids "
        "that hold 0.9 according to its covariance; length: of either, as above. ms: CPU time of a frame, from the "
        "decoded image to pose and region; map_s: CPU time of `train` or of the map, from images. mb: of the model, "
        "or of what the map needs: descriptors in bytes, points and retrieval in single precision."
    )
    write_page(
        "recordings",
        "Another recording of a known place",
        f"python benchmarks/recordings.py --seed {options.seed}",
        table_lines(["frames", "system", "from", *columns], rows),
        note,
        table_lines(["frames", "system", *beside], peers),
        peer_note,
    )


if __name__ == "__main__":
    main()
