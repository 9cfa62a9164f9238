"""Cameras: errors and regions, disturbed images, and coverage where regions are large; or what each part contributes.

python benchmarks/cameras.py [--seeds 40 41 42] [--worlds ...] [--workers 2] [--ablations]
"""

from __future__ import annotations

import os
import shlex
import sys
from dataclasses import replace
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # two trainings side by side

import cv2
import numpy as np
from common import (
    RUNS,
    cached_json,
    excess_risk,
    filtered_path,
    mean_interval,
    parser_with_seeds,
    rmse,
    table_lines,
    without_limits,
    without_rotations,
    write_page,
)
from joblib import Parallel, delayed
from scipy.stats import chi2
from worlds import ALPHA, FAR_M, VARIANTS, WORLDS, Laboratory, frame_by_frame, slug, summary

from conformodal.io import Disturbance
from conformodal.pipeline.model import ONLINE

DISTURBED = ("redkitchen, blocks", "fr1_xyz from fr1_desk", "fr1_rpy from fr1_desk and fr1_xyz")
ABLATED = (*tuple(WORLDS)[:4], "corridor, new laps after three")
OTHERS = ("without motion", "without the filter")
ELLIPSOIDS = (0.5, 0.9, 0.99)
QUARTERS = ("smallest", "second", "third", "largest")
COLUMNS = {
    "rmse_m": 4, "median_m": 4, "far": 3, "coverage": 3, "bounded": 3, "of bounded": 3, "places": 2, "length_m": 3,
    "reliable": 2, "elsewhere": 3,
}  # fmt: skip
Frames = dict[str, dict[str, Any]]


def measured(world: str, seed: int, variant: str) -> dict[str, Any]:
    """Frames of a variant, and for ours what motion and the filter give, and disturbed images."""
    cv2.setNumThreads(1)
    lab = Laboratory(world, seed)
    model = lab.model(variant)
    run = lab.run(model)
    results: dict[str, Any] = {"frames": frame_by_frame(lab, run)}
    if variant != "ours":
        return results
    truth, observed = lab.truth(run).positions_xyz, run.observations(np.arange(len(run.frames)))
    path = filtered_path(without_rotations(observed), without_limits(model.prior), hindsight=False)
    results["without motion"] = rmse(np.linalg.norm(path.positions_xyz - truth, axis=1))
    results["without the filter"] = rmse(results["frames"]["image alone"]["off_m"])
    if world in DISTURBED:
        for name, changed in (("disturbed", model), ("without their type", replace(model, quality=None))):
            results[name] = frame_by_frame(lab, lab.run(changed, noise=Disturbance(seed)))
    return results


def unit(world: str, seed: int, variant: str) -> dict[str, Any]:
    """The numbers of a variant, kept."""
    file = RUNS / "cameras" / f"{slug(world)}-{seed}-{slug(variant)}.json"
    result: dict[str, Any] = cached_json(file, partial(measured, world, seed, variant))
    print(file.stem, flush=True)
    return result


def cells(runs: list[Frames], name: str, columns: dict[str, int]) -> list[str]:
    """Means over seeds and their intervals."""
    numbers = [summary(run[name]) for run in runs]
    return [mean_interval([one[key] for one in numbers if key in one], digits) for key, digits in columns.items()]


def consistency_cells(runs: list[Frames]) -> list[str]:
    """Shares of errors within the ellipsoids that the stated covariance gives these probabilities, of all seeds."""
    squared = np.concatenate([run[ONLINE]["squared"] for run in runs])
    within = [f"{np.mean(squared <= chi2.ppf(share, 6)):.3f}" for share in ELLIPSOIDS]
    return [str(len(squared)), *within, f"{np.median(squared) / chi2.median(6):.2f}"]


def conditional_cells(runs: list[Frames]) -> list[str]:
    """Coverage by quarters of the length of the region, bounded ones of all seeds, and how far it can be predicted."""
    held, length, places = (
        np.concatenate([run["image alone"][k] for run in runs]) for k in ("held", "length_m", "places")
    )
    bounded = length >= 0
    order = np.argsort(length[bounded], kind="stable")
    quarters = [f"{part.mean():.3f}" for part in np.array_split(held[bounded][order], len(QUARTERS))]
    risk = excess_risk(np.column_stack((length, places))[bounded], held[bounded], ALPHA)
    return [str(int(bounded.sum())), *quarters, "" if risk is None else f"{risk:.4f}"]


def measured_units(keys: list[tuple[str, int, str]], workers: int) -> dict[tuple[str, int, str], dict[str, Any]]:
    """The numbers of worlds, seeds and variants."""
    return dict(zip(keys, Parallel(workers, batch_size=1)(delayed(unit)(*key) for key in keys), strict=True))


def write_ablations(worlds: list[str], seed: int, workers: int) -> None:
    """The page of what each part contributes."""
    results = measured_units([(world, seed, variant) for world in worlds for variant in VARIANTS], workers)
    parts = []
    for variant in VARIANTS:
        row = [variant]
        for world in worlds:
            one = results[world, seed, variant]["frames"]
            alone = summary(one["image alone"])
            row.append(f"{summary(one['online'])['rmse_m']:.4f}, {alone['coverage']:.3f}, {alone['length_m']:.3f}")
        parts.append(row)
    parts += [[part, *(f"{results[world, seed, 'ours'][part]:.4f}" for world in worlds)] for part in OTHERS]
    write_page(
        "camera_ablations",
        "Camera ablations",
        shlex.join(["python", *sys.argv]),
        f"Seed {seed}: position RMSE online in metres, coverage at alpha = {ALPHA} and median length of the image's "
        "regions. The path without motion or without the filter is that of the same model.",
        table_lines(["system", *worlds], parts),
    )


def main() -> None:
    parser = parser_with_seeds(__doc__)
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=WORLDS)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--ablations", action="store_true", help="the systems without a part instead, with the first seed"
    )
    options = parser.parse_args()
    if options.ablations:
        write_ablations([world for world in ABLATED if world in options.worlds], options.seeds[0], options.workers)
        return
    keys = [(world, seed, "ours") for seed in options.seeds for world in options.worlds]
    results = measured_units(keys, options.workers)
    ours = {world: [results[world, seed, "ours"] for seed in options.seeds] for world in options.worlds}
    frames = {world: [one["frames"] for one in each] for world, each in ours.items()}
    errors = [[w, name, *cells(runs, name, COLUMNS)] for w, runs in frames.items() for name in runs[0]]
    shown = {key: COLUMNS[key] for key in ("coverage", "bounded", "of bounded", "length_m")}
    disturbed = [
        [world, name, *cells([one[name] for one in ours[world]], "image alone", shown)]
        for world in DISTURBED
        if world in ours
        for name in ("disturbed", "without their type")
    ]
    write_page(
        "cameras",
        "Cameras: errors and regions",
        shlex.join(["python", *sys.argv]),
        "## Errors and regions",
        f"Mean over seeds {options.seeds} and 95 % interval. Landmarks are XFeat's, ORB's in the corridor. Far: over "
        f"{FAR_M} m. Coverage of the whole pose at alpha = {ALPHA}, unbounded regions included, and of bounded ones "
        "alone; what calibrates regions, and what is guaranteed, is in docs/guarantees.md: nothing of another "
        "recording. Places: boxes of bounded regions; length: median of the mean along x, y and z. Reliable: share of "
        "the frames; elsewhere: reliable, and the chosen pose at another place. Settings were chosen on redkitchen, "
        "the corridor and fr1, fr1_rpy among them, with seeds 0 to 2 and 10 to 29; icl_living_room chose nothing. By "
        "SfM: the same images with poses from structure from motion.",
        table_lines(["world", "from", *COLUMNS], errors),
        "## Disturbed images",
        "All images disturbed at random (light, blur, noise, covered parts); regions of the image alone.",
        table_lines(["world", "images", *shown], disturbed),
        "## Consistency",
        "Squared errors of the poses that a stream gives over the covariance it states, beside the chi-squared law "
        "with six degrees of freedom: share of all frames, all seeds, within the ellipsoids of 50, 90 and 99 %, and "
        "the median over that of the law. More within than stated, or a median below 1: cautious. The ellipsoid of "
        "90 % is calibrated, under the assumptions of regions from all frames so far.",
        table_lines(
            ["world", "n", *(f"within {100 * share:g} %" for share in ELLIPSOIDS), "median"],
            [[w, *consistency_cells(r)] for w, r in frames.items()],
        ),
        "## Coverage where regions are large",
        "Bounded regions of the image alone, all seeds, in quarters of their length; and the excess risk: the Brier "
        "score of the nominal coverage less that of a classifier that predicts from length and number of places "
        "whether a region holds, cross-fitted (after arXiv 2512.11779; 0 or less: not predictable).",
        table_lines(["world", "n", *QUARTERS, "excess risk"], [[w, *conditional_cells(r)] for w, r in frames.items()]),
    )


if __name__ == "__main__":
    main()
