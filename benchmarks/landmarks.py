"""Absolute poses from landmarks with other local features and other retrieval: errors and time, image by image.

python benchmarks/landmarks.py

What settings of local features and retrieval were chosen by. A map of every second frame of two thirds of a recording
(fr1_xyz: of fr1_desk) localises some frames of the rest, as they are and disturbed at random. Neither motion nor the
other sources help.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch

import numpy as np
from common import DATA, parser_of, write_table

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.files import default_cache_dir
from conformodal.features import networks
from conformodal.features.backbone import at_unit_length, coarse_features
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.local import Detector
from conformodal.io import Disturbance, Recording, read_recording
from conformodal.localizer.overlap import near_known
from conformodal.localizer.sources.landmark_map import LandmarkMap
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.train import prepare_training_data
from conformodal.tracking.depths import track_depth
from conformodal.tracking.motions import frame_features

KITCHEN, DESK, XYZ = "7scenes/redkitchen", "tum/fr1_desk", "tum/fr1_xyz"
PARTS = [(KITCHEN, 0), *((DESK, third) for third in range(3))]
FAR_M, ASKED = 0.3, 40  # a large error; images that are localised, of each part


VARIANTS = {  # whether the network retrieves, the detector, and the pixels of images that XFeat sees
    "XFeat at 0.7 of the size": (False, "xfeat", networks.XFEAT_PIXELS),
    "XFeat at full size": (False, "xfeat", 640 * 480),
    "XFeat at half size": (False, "xfeat", 320 * 256),
    "ORB": (True, "orb", 0),
}


def detector_of(name: str, pixels: int, recording: Recording) -> Detector:
    """A detector for the images of a recording."""
    with patch.object(networks, "XFEAT_PIXELS", pixels):
        return networks.make_detector(name, recording.camera)


def split(mapped: Recording, new: Recording, third: int | None) -> tuple[IntArray, IntArray]:
    """Frames that are mapped, and those that are localised: all have a mapped view within 0.3 m and 30 degrees."""
    n = len(new)
    out = np.arange(n) if third is None else np.arange(third * n // 3, (third + 1) * n // 3)
    frames = np.arange(len(mapped)) if third is None else np.setdiff1d(np.arange(n), out)[::2]
    near = near_known(new.require_truth()[out], mapped.require_truth()[frames], FAR_M, np.radians(30.0))
    out = out[near]
    return frames, out[:: max(1, len(out) // ASKED)]


def errors(source: str, target: str, third: int | None) -> dict[tuple[str, bool], tuple[FloatArray, float]]:
    """By variant and whether images are disturbed: errors in metres, inf where there is none, and ms per image."""
    mapped, new, cache = read_recording(DATA / source), read_recording(DATA / target), FeatureCache(default_cache_dir())
    frames, asked = split(mapped, new, third)
    data = prepare_training_data(mapped, ModelConfig(), cache)
    depth_m, grid = track_depth(mapped, frames).median_m, data.backbone.config.grid
    truth = new.require_truth().positions_xyz[asked]
    queries = {disturbed: replace(new, noise=Disturbance(0) if disturbed else None) for disturbed in (False, True)}
    paths = [new.image_paths[i] for i in asked]
    query_maps = {
        disturbed: at_unit_length(
            coarse_features(extract_features(paths, data.backbone, cache, None, query.noise), grid)
        )
        for disturbed, query in queries.items()
    }
    results: dict[tuple[str, bool], tuple[FloatArray, float]] = {}
    for name, (by_network, kind, pixels) in VARIANTS.items():
        detector = detector_of(kind, pixels, mapped)
        images = [frame_features(mapped, i, detector) for i in frames.tolist()]
        if by_network:
            maps = at_unit_length(coarse_features(data.features[frames], grid))
            images = [image._replace(global_descriptor=row) for image, row in zip(images, maps, strict=True)]
        built = LandmarkMap.build(images, mapped.require_truth()[frames].poses_se3, mapped.camera, depth_m)
        for disturbed, query in queries.items():
            positions, began = np.full((len(asked), 3), np.inf), time.process_time()
            for k, i in enumerate(asked.tolist()):
                image = frame_features(query, i, detector)
                if by_network:
                    image = image._replace(global_descriptor=query_maps[disturbed][k])
                if estimates := built.localize(image):
                    positions[k] = max(estimates, key=lambda one: one.n_inliers).position_xyz
            ms = 1e3 * (time.process_time() - began) / len(asked)
            off = np.linalg.norm(positions - truth, axis=1)
            results[name, disturbed] = off, ms
            print(source, target, third, name, disturbed, np.median(off), ms, flush=True)
    return results


def main() -> None:
    parser_of(__doc__).parse_args()
    places = {"redkitchen": PARTS[:1], "fr1_desk": PARTS[1:], "fr1_xyz from fr1_desk": [(DESK, None)]}
    rows = []
    for place, parts in places.items():
        results = [errors(name, XYZ if third is None else name, third) for name, third in parts]
        for disturbed in (False, True):
            for name in VARIANTS:
                off = np.concatenate([result[name, disturbed][0] for result in results])
                ms = float(np.mean([result[name, disturbed][1] for result in results]))
                errors_m = f"{np.median(off):.4f}", f"{np.quantile(off, 0.9):.4f}"
                shares = f"{np.mean(off > FAR_M):.3f}", f"{np.mean(~np.isfinite(off)):.3f}"
                kind = "disturbed" if disturbed else "as they are"
                rows.append([place, kind, name, str(len(off)), *errors_m, *shares, f"{ms:.0f}"])
    header = ["place", "images", "variant", "n", "median_m", "q90_m", "far", "none", "ms"]
    note = (
        "The estimate of each image with the most inliers. Far: off by more than 0.3 m, or "
        "none. ms: CPU time of an image, read, described and localised, beside other work. The first variant is the "
        "present one."
    )
    title, command = "Local features and retrieval", "python benchmarks/landmarks.py"
    write_table("landmarks", title, command, header, rows, note)


if __name__ == "__main__":
    main()
