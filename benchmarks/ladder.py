"""From the paper's system to ours, one change at a time; and ours with one part left out at a time.

python benchmarks/ladder.py [--seeds 10 11 12 13 14] [--places ...] [--runs FOLDER] [--workers 2] [--quick]

Models are kept in the folder of runs, numbers in benchmarks/results/ladder: what is there is not worked out again.
`--quick` trains ours alone: a tenth of the time, and no row that needs another model; a later run without it works
these numbers out anew.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: two trainings side by side

import cv2
import numpy as np
import torch
from common import RESULTS, ROOT
from conformodal.reasoning.viterbi import viterbi
from joblib import Parallel, delayed
from ladder_parts import ALL, REMOVED, STEPS, SWITCHES, Frames, Paths, spaced
from ladder_runs import ALPHA, PLACES, Models, Trained
from ladder_tables import write_tables

from conformodal.conformal import SplitConformal
from conformodal.localization.evidence import FrameEvidence
from conformodal.localization.local_features import extract_local_features
from conformodal.localization.targets import pose_targets
from conformodal.motion.essential import EssentialFrontEnd
from conformodal.reasoning.observations import Observations
from conformodal.reasoning.smoother import smooth
from conformodal.running.motions import measure_motions
from conformodal.running.paper_odometry import PaperOdometry
from conformodal.running.results.provenance import provenance

SEEDS = (10, 11, 12, 13, 14)
EVERY = {"1/6 s": 0.0, "1 s": 1.0, "3 s": 3.0}  # a fifth of 30 frames a second: a sixth of a second apart
SPARSE = ("TUM cabinet", "KITTI 06")  # too few frames to take fewer
LAC = "score `lac`, each target by itself"


def steps(models: Models, seen: Frames, ours: Paths) -> dict[str, list[float]]:
    """Errors from the paper's system on, one change more each."""
    paper = models.paper()
    essential = measure_motions(
        models.sequence, seen.frames, front_end=EssentialFrontEnd(models.sequence.camera), local=False
    )
    run = PaperOdometry(paper.model).process(models.sequence, seen.frames, cache=models.cache, motions=essential)
    found = {"the paper's system": seen.error(run.trajectories["greedy"])}
    on_map = Paths(models.step("map", projected=False), seen)
    found["a map of features instead of their average"] = seen.error(on_map.greedy(motions=essential))
    if models.unprojected() is not None:
        projected = Paths(models.step("projected", projected=True), seen)
        found["projection on principal components"] = seen.error(projected.greedy(motions=essential))
    model, targets = (
        ours.trained.model,
        pose_targets(models.sequence.require_truth(), ours.trained.model.sign_reference),
    )
    held_out = model.split.calibration
    lac = SplitConformal(model.bins, ALPHA, "lac", "none")
    lac.calibrate(_proba(ours.trained, held_out), targets[held_out])
    found["order-aware labels, bins with a margin"] = seen.error(ours.greedy(lac, essential))
    found["score by density, one threshold for the pose"] = seen.error(ours.greedy(motions=essential))
    found["relative motion by PoseLib"] = seen.error(ours.greedy())
    return found | {name: seen.error(ours.path(parts)) for name, parts in STEPS.items()}


def _proba(trained: Trained, frames: np.ndarray) -> list[np.ndarray]:
    """Softmaxes of some frames."""
    return trained.model.localizer.beliefs(FrameEvidence(trained.features[frames])).proba


def regions(trained: Trained, seen: Frames) -> dict[str, Any]:
    """Coverage of the whole pose and mean length of the position's sets in standard deviations, known frames only."""
    model = trained.model
    targets = pose_targets(seen.sequence.require_truth(), model.sign_reference)
    spread, truth = targets[model.split.train].std(axis=0), targets[seen.frames]
    held_out = model.split.calibration
    lac = SplitConformal(model.bins, ALPHA, "lac", "max")
    lac.rule.keep_scale()  # probabilities of all targets are on one scale
    lac.calibrate(_proba(trained, held_out), targets[held_out])
    paths = Paths(trained, seen)
    without = model.localize(FrameEvidence(paths.features))
    found = {
        "overall": without.regions,
        "lac": lac.predict(without.beliefs.proba),
        "all": paths.localization(ALL).regions,
    }
    return {
        name: [
            float(r.contains(truth, joint=True)[without.known].mean()),
            float((r.length / spread)[without.known, :3].mean()),
        ]
        for name, r in found.items()
    }


def milliseconds(trained: Trained, models: Models, seen: Frames) -> dict[str, float]:
    """Of each part for one frame."""
    model, paths = trained.model, Paths(trained, seen)
    image, n = models.sequence.image(int(seen.frames[0])), len(seen.frames)
    chosen, found, evidence = paths.path(ALL), paths.localization(ALL), paths.evidence
    given = Observations(found.candidates, seen.relative, seen.times, [])
    thresholds = model.rules.thresholds(found.kinds)

    def ms(work: Callable[[], object], count: int) -> float:
        work()
        started = time.perf_counter()
        work()
        return 1e3 * (time.perf_counter() - started) / count

    sources = {s.name: ms(lambda s=s: s.answer(evidence), n) for s in model.localizer.sources}
    return {
        "network": ms(lambda: model.backbone.features_of(image), 1),
        "local features": ms(lambda: extract_local_features(image, models.sequence.camera), 1),
        **sources,
        "belief": ms(lambda: model.localizer.beliefs(evidence), n),
        "region of a belief": ms(lambda: model.regions(found.beliefs, thresholds), n),
        "novelty": ms(lambda: model.novelty.p_values(evidence.features) if model.novelty else None, n),
        "Viterbi": ms(lambda: viterbi(given, model.prior), n),
        "smoother": ms(lambda: smooth(chosen, given, model.prior), n),
    }


def measured(place: str, seed: int, runs: Path, *, quick: bool) -> dict[str, Any]:
    """All numbers of a place and a seed."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    models = Models(place, seed, runs)
    ours = models.ours()
    views = () if quick else ("network", "thumbnail")
    others = {view: its for view in views if (its := models.neighbours(view)) is not None}
    retrained: dict[str, Trained | None] = {}
    if not quick:
        retrained = {
            "order-aware labels": models.unlabelled(),
            "the map of features": models.averaged(),
            "projection": models.unprojected(),
            "a small network (larger instead)": models.larger(),
        }
    test = ours.model.split.test
    found: dict[str, Any] = {
        "source": provenance()["source_revision"],
        "quick": quick,
        "train_s": ours.seconds,
        "retrained_s": {name: sum(one.seconds.values()) for name, one in retrained.items() if one},
    }
    for name, interval in ({"all": 0.0} if place in SPARSE else EVERY).items():
        frames = spaced(models.sequence.timestamps_s, test, interval) if interval else test
        seen = Frames(models.sequence, frames, measure_motions(models.sequence, frames))
        paths = Paths(ours, seen, others)
        removed = {part: parts for part, parts in REMOVED.items() if not quick or parts.neighbours in ("both", "none")}
        here = {
            "frames": len(frames),
            "ours": seen.error(paths.path(ALL)),
            "removed": {part: seen.error(paths.path(parts)) for part, parts in removed.items()},
            "switches": {part: seen.error(paths.path(parts)) for part, parts in SWITCHES.items()},
            "steps": {} if quick else steps(models, seen, paths),
        }
        if quick:
            here["steps"] = {part: seen.error(paths.path(parts)) for part, parts in STEPS.items()}
        for part, other in retrained.items():
            if other is not None:
                here["removed"][part] = seen.error(Paths(other, seen).path(ALL))
        found[name] = here
        if not interval:
            found["regions"] = {"ours": regions(ours, seen)}
            found["regions"] |= {part: regions(other, seen) for part, other in retrained.items() if other}
            found["ms"] = milliseconds(ours, models, seen)
    return found


def is_there(file: Path, *, quick: bool) -> bool:
    """Whether numbers are there; those of a quick run are enough for a quick run alone."""
    return file.is_file() and (quick or not json.loads(file.read_text()).get("quick", False))


def store(file: Path, place: str, seed: int, runs: Path, **options: bool) -> tuple[str, int]:
    """Measure one place with one seed and write its numbers."""
    part = file.with_suffix(".part")
    part.write_text(json.dumps(measured(place, seed, runs, **options), indent=1) + "\n")
    part.replace(file)
    return place, seed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--places", nargs="+", default=list(PLACES), choices=PLACES)
    parser.add_argument("--runs", type=Path, default=ROOT / "ladder-out")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--quick", action="store_true", help="ours alone")
    asked = parser.parse_args()
    numbers = RESULTS / "ladder"
    numbers.mkdir(parents=True, exist_ok=True)
    wanted = {
        (p, s): numbers / f"{p.replace(', ', '-').replace(' ', '-')}-{s}.json"
        for s in asked.seeds
        for p in asked.places
    }
    jobs = (
        delayed(store)(file, place, seed, asked.runs, quick=asked.quick)
        for (place, seed), file in wanted.items()
        if not is_there(file, quick=asked.quick)
    )
    for key in Parallel(asked.workers, return_as="generator_unordered", batch_size=1)(jobs):
        print(time.strftime("%H:%M:%S"), *key, flush=True)
    write_tables({key: json.loads(file.read_text()) for key, file in wanted.items() if file.is_file()})


if __name__ == "__main__":
    main()
