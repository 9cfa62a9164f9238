"""Which images the novelty test takes for unknown, at several levels, on the seeds that the default was chosen on.

python benchmarks/novelty.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from common import parser_of, write_table
from unseen import ALPHA, KNOWN, corridor_flights

from conformodal.core.files import default_cache_dir
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.regions import PlaceNovelty
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.train import prepare_training_data
from conformodal.pipeline.training_data import make_folds

SEEDS = (20, 21, 22)
LEVELS = (0.005, 0.01, 0.015, 0.02, 0.03, 0.05)


def p_values(seed: int, cache: FeatureCache, scratch: Path) -> dict[str, np.ndarray]:
    """Of frames of the known corridor that were held out, and of flights."""
    sequence, flights = corridor_flights(seed, scratch)
    data = prepare_training_data(sequence, ModelConfig(seed=seed, alpha=ALPHA), cache)
    folds = make_folds(sequence, data.split)
    frames = folds.region_frames
    novelty = PlaceNovelty.fit(data.features[frames], folds.pieces[frames], data.backbone.config.grid)
    assert novelty is not None
    by_flight = {KNOWN: novelty.p_values(FrameEvidence(data.features[data.split.test]))}
    for name, flight in flights.items():
        by_flight[name] = novelty.p_values(FrameEvidence(extract_features(flight.image_paths, data.backbone, cache)))
    return by_flight


def main() -> None:
    parser_of(__doc__).parse_args()
    cache, results = FeatureCache(default_cache_dir()), []
    for seed in SEEDS:
        with tempfile.TemporaryDirectory() as scratch:
            results.append(p_values(seed, cache, Path(scratch)))
    rows = []
    for name in results[0]:
        shares = [[np.mean(each[name] <= level) for each in results] for level in LEVELS]
        cells = [f"{np.mean(share):.3f} ({min(share):.2f} to {max(share):.2f})" for share in shares]
        rows.append([name, *cells])
    note = (
        "Share of frames with a p-value of at most the level (columns), mean and range over corridors with seeds "
        f"{SEEDS}; split interleaved, every frame a piece of its own. Held-out frames of the known place are "
        "exchangeable with the reference frames: at most the level is taken for unknown in the mean. The default, "
        "0.015, was chosen on this table; what follows on other seeds: [unseen.md](unseen.md)."
    )
    header = ["frames", *map(str, LEVELS)]
    write_table("novelty", "The level of the novelty test", "python benchmarks/novelty.py", header, rows, note)


if __name__ == "__main__":
    main()
