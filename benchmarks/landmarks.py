"""Absolute poses from landmarks with other local features and other retrieval: errors and time, image by image.

python benchmarks/landmarks.py

What settings of local features and retrieval were chosen by. A map of every second frame of two thirds of a recording
(fr1_xyz: of fr1_desk) localises some frames of the rest, as they are and disturbed at random. Neither motion nor the
other sources help.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch

import cv2
import numpy as np
from common import DATA, write_table

from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.files import default_cache_dir
from conformodal.features import local as local_features
from conformodal.features.backbone import global_descriptors
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.local import LocalFeatures, extract_local_features
from conformodal.features.settings import LOCAL_FEATURES
from conformodal.geometry.undistortion import undistort
from conformodal.io import Disturbance, Recording, read_recording
from conformodal.io.joining import near_known
from conformodal.localizer.settings import GUIDING
from conformodal.localizer.sources import keyframes, mapping
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.depths import measure_depths
from conformodal.pipeline.train import prepare_training_data
from conformodal.tracking.flow import frame_features

KITCHEN, DESK, XYZ = "7scenes/redkitchen", "tum/fr1_desk", "tum/fr1_xyz"
PARTS = [(KITCHEN, 0), *((DESK, third) for third in range(3))]
FAR_M, ASKED = 0.3, 40  # a large error; images that are localised, of each part


def sift(image: Any, camera: Any) -> LocalFeatures:
    """SIFT with as many corners as the settings say."""
    orb = extract_local_features(image, camera)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    corners, found = cv2.SIFT.create(local_features.LOCAL_FEATURES.max_corners).detectAndCompute(grey, None)
    if found is None:
        return orb._replace(pixels=np.empty((0, 2)), descriptors=np.empty((0, 128), np.uint8))
    return orb._replace(pixels=undistort(np.array([c.pt for c in corners]), camera), descriptors=found.astype(np.uint8))


def match_sift(one: Any, other: Any) -> IntArray:
    """As :func:`~conformodal.features.local.match`, by Euclidean distance and a ratio of 0.8."""
    if len(one) == 0 or len(other) < 2:
        return np.empty((0, 2), np.int64)
    a, b = one.astype(np.float32), other.astype(np.float32)
    away = np.sqrt(np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * a @ b.T, 0))
    rows, nearest = np.arange(len(a)), away.argmin(axis=1)
    first = away[rows, nearest]
    away[rows, nearest] = np.inf
    rows = rows[first < 0.8 * away.min(axis=1)]
    rows = rows[np.argsort(first[rows], kind="stable")]
    rows = rows[np.unique(nearest[rows], return_index=True)[1]]
    return np.column_stack((rows, nearest[rows])).astype(np.int64)


@contextmanager
def features(extract: Callable[..., LocalFeatures], corners: int, *, guided: bool = True) -> Iterator[None]:
    """Other local features; SIFT is matched by other distances, and not guided by a first pose."""
    least = GUIDING.least_inliers if guided else 10**9
    with (
        patch.object(local_features, "extract_local_features", extract),
        patch.object(local_features, "LOCAL_FEATURES", replace(LOCAL_FEATURES, max_corners=corners)),
        patch.object(keyframes, "GUIDING", replace(GUIDING, least_inliers=least)),
        patch.object(keyframes, "match", match_sift if extract is sift else keyframes.match),
        patch.object(local_features, "match", match_sift if extract is sift else local_features.match),
    ):
        yield


VARIANTS: dict[str, tuple[bool, Callable[[], Any]]] = {  # whether the network retrieves, and the features
    "ORB, 500 corners": (True, partial(features, extract_local_features, 500)),
    "retrieved by thumbnails": (False, partial(features, extract_local_features, 500)),
    "1000 corners": (True, partial(features, extract_local_features, 1000)),
    "2000 corners": (True, partial(features, extract_local_features, 2000)),
    "not guided": (True, partial(features, extract_local_features, 500, guided=False)),
    "SIFT, 1000 corners, not guided": (True, partial(features, sift, 1000, guided=False)),
}


def split(known: Recording, new: Recording, third: int | None) -> tuple[IntArray, IntArray]:
    """Frames that are mapped, and those that are localised: all have a known view within 0.3 m and 30 degrees."""
    n = len(new)
    out = np.arange(n) if third is None else np.arange(third * n // 3, (third + 1) * n // 3)
    mapped = np.arange(len(known)) if third is None else np.setdiff1d(np.arange(n), out)[::2]
    near = near_known(new.require_truth()[out], known.require_truth()[mapped], FAR_M, np.radians(30.0))
    out = out[near]
    return mapped, out[:: max(1, len(out) // ASKED)]


def errors(source: str, target: str, third: int | None) -> dict[tuple[str, bool], tuple[FloatArray, float]]:
    """By variant and whether images are disturbed: errors in metres, inf where there is none, and ms per image."""
    known, new, cache = read_recording(DATA / source), read_recording(DATA / target), FeatureCache(default_cache_dir())
    mapped, asked = split(known, new, third)
    data = prepare_training_data(known, ModelConfig(), cache)
    found: dict[tuple[str, bool], tuple[FloatArray, float]] = {}
    depth_m, grid = measure_depths(known, mapped)[0], data.backbone.config.grid
    asked_paths, truth = [new.image_paths[i] for i in asked], new.require_truth().positions_xyz
    seen = {disturbed: replace(new, noise=Disturbance(0) if disturbed else None) for disturbed in (False, True)}
    maps = {
        disturbed: global_descriptors(extract_features(asked_paths, data.backbone, cache, None, its.noise), grid)
        for disturbed, its in seen.items()
    }
    for name, (by_network, of) in VARIANTS.items():
        with of():
            images = [frame_features(known, i) for i in mapped.tolist()]
            if by_network:
                known_maps = global_descriptors(data.features[mapped], grid)
                images = [its._replace(global_descriptor=row) for its, row in zip(images, known_maps, strict=True)]
            built = mapping.build_map(images, known.require_truth()[mapped].poses_se3, known.camera, depth_m)
            for disturbed, its in seen.items():
                off, began = [], time.process_time()
                for i, row in zip(asked.tolist(), maps[disturbed], strict=True):
                    image = frame_features(its, i)
                    estimates = built.localize(image._replace(global_descriptor=row) if by_network else image)
                    first = estimates[0].position_xyz if estimates else np.full(3, np.inf)
                    off.append(float(np.linalg.norm(first - truth[i])))
                ms = 1e3 * (time.process_time() - began) / len(asked)
                found[name, disturbed] = np.array(off), ms
                print(source, target, third, name, disturbed, np.median(off), ms, flush=True)
    return found


def main() -> None:
    places = {"redkitchen": PARTS[:1], "fr1_desk": PARTS[1:], "fr1_xyz from fr1_desk": [(DESK, None)]}
    rows = []
    for place, parts in places.items():
        its = [errors(name, XYZ if third is None else name, third) for name, third in parts]
        for disturbed in (False, True):
            for name in VARIANTS:
                off = np.concatenate([one[name, disturbed][0] for one in its])
                ms = float(np.mean([one[name, disturbed][1] for one in its]))
                errors_m = f"{np.median(off):.4f}", f"{np.quantile(off, 0.9):.4f}"
                shares = f"{np.mean(off > FAR_M):.3f}", f"{np.mean(~np.isfinite(off)):.3f}"
                kind = "disturbed" if disturbed else "as they are"
                rows.append([place, kind, name, str(len(off)), *errors_m, *shares, f"{ms:.0f}"])
    header = ["place", "images", "variant", "n", "median_m", "q90_m", "far", "none", "ms"]
    note = (
        "The first estimate of each image, of the most similar cluster of keyframes. Far: off by more than 0.3 m, or "
        "none. ms: CPU time of an image, read, described and localised, beside other work. The first variant is the "
        "present one, of which each other changes one thing (SIFT: from `not guided`)."
    )
    line = "python benchmarks/landmarks.py"
    write_table("landmarks", "Local features and retrieval", line, header, rows, note)


if __name__ == "__main__":
    main()
