"""From the paper's system to ours, one change at a time; and ours with one part left out at a time.

python benchmarks/ladder.py [--seeds 10 11 12 13 14] [--places ...] [--runs FOLDER] [--workers 2] [--tuned]

Models are kept in the folder of runs, numbers in benchmarks/results/ladder: what is there is not worked out again.
`--tuned` also trains models with fine-tuned networks, minutes each.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: two trainings side by side

import cv2
import numpy as np
import torch
from common import RESULTS, ROOT
from ladder_parts import ALL, REMOVED, STEPS, SWITCHES, Frames, Paths, spaced
from ladder_runs import ALPHA, PLACES, Models, Trained
from ladder_tables import write_tables

from conformodal.conformal import SplitConformal
from conformodal.motion import EssentialFrontEnd, describe
from conformodal.odometry import Fixes, PaperOdometry, measure_motions, pose_targets, provenance
from conformodal.reasoning import smooth, viterbi

SEEDS = (10, 11, 12, 13, 14)
EVERY = {"1/6 s": 0.0, "1 s": 1.0, "3 s": 3.0}  # a fifth of 30 frames a second: a sixth of a second apart
SPARSE = ("TUM cabinet", "KITTI 06")  # too few frames to take fewer
LAC = "score `lac`, each target by itself"


def frames_of(trained: Trained, models: Models, frames: np.ndarray, fixes: dict[int, Fixes]) -> Frames:
    model, sequence = trained.model, models.sequence
    motions = measure_motions(sequence, frames)
    for i in frames.tolist():
        if i not in fixes:
            fixes[i] = model.fixes(motions.described[i])
    known_p = model.known_p(trained.features[frames])
    return Frames(sequence, frames, motions, [fixes[i] for i in frames.tolist()], known_p)


def steps(models: Models, seen: Frames, ours: Paths) -> dict[str, list[float]]:
    """Errors from the paper's system on, one change more each."""
    paper = models.paper()
    essential = measure_motions(
        models.sequence, seen.frames, front_end=EssentialFrontEnd(models.sequence.camera), landmarks=False
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
    lac.calibrate(model.proba(ours.trained.features[held_out]), targets[held_out])
    found["order-aware labels, bins with a margin"] = seen.error(ours.greedy(lac, essential))
    found["score by density, one threshold for the pose"] = seen.error(ours.greedy(motions=essential))
    found["relative motion by PoseLib"] = seen.error(ours.greedy())
    return found | {name: seen.error(ours.path(parts)) for name, parts in STEPS.items()}


def regions(trained: Trained, seen: Frames) -> dict[str, Any]:
    """Coverage of the whole pose and mean length of the position's sets in standard deviations, known frames only."""
    model = trained.model
    targets = pose_targets(seen.sequence.require_truth(), model.sign_reference)
    spread, truth = targets[model.split.train].std(axis=0), targets[seen.frames]
    proba = model.proba(trained.features[seen.frames])
    known = seen.known_p > model.rules.level
    held_out = model.split.calibration
    lac = SplitConformal(model.bins, ALPHA, "lac", "max")
    lac.rule.keep_scale()  # probabilities of all targets are on one scale
    lac.calibrate(model.proba(trained.features[held_out]), targets[held_out])
    found = {
        "softmax": model.regions(proba, known_p=seen.known_p),
        "lac": lac.predict(proba),
        "landmarks": model.regions(proba, seen.fixes, known_p=seen.known_p),
    }
    return {
        name: [float(r.contains(truth, joint=True)[known].mean()), float((r.length / spread)[known, :3].mean())]
        for name, r in found.items()
    }


def milliseconds(trained: Trained, models: Models, seen: Frames) -> dict[str, float]:
    """Of each part for one frame."""
    model, features = trained.model, trained.features[seen.frames]
    image = models.sequence.image(int(seen.frames[0]))
    n, described = len(features), [seen.motions.described[i] for i in seen.frames.tolist()]
    ours = Paths(trained, seen)
    chosen = ours.path(ALL)
    given = _given(ours)
    proba = model.proba(features)

    def ms(work: Callable[[], object], count: int) -> float:
        work()
        started = time.perf_counter()
        work()
        return 1e3 * (time.perf_counter() - started) / count

    return {
        "network": ms(lambda: model.backbone.describe(model.backbone.prepare(image)[None]), 1),
        "region from the softmax": ms(lambda: model.regions(proba, known_p=seen.known_p), n),
        "region with landmarks": ms(lambda: model.regions(proba, seen.fixes, known_p=seen.known_p), n),
        "ensemble and neighbours": ms(lambda: model.search(features), n),
        "neighbours": ms(lambda: None if model.local is None else model.local.regression.predict(features), n),
        "corners of landmarks": ms(lambda: describe(image, models.sequence.camera), 1),
        "landmarks, two maps": ms(lambda: [model.fixes(d) for d in described], n),
        "novelty": ms(lambda: model.known_p(features), n),
        "Viterbi": ms(lambda: viterbi(given, model.prior), n),
        "smoother": ms(lambda: smooth(chosen, given, model.prior), n),
    }


def _given(paths: Paths) -> Any:
    model, seen = paths.trained.model, paths.seen
    from conformodal.reasoning import Observations  # noqa: PLC0415

    candidates = model.candidates(model.search(paths.features), seen.fixes)
    return Observations(candidates, seen.relative, seen.times, [])


def measured(place: str, seed: int, runs: Path, *, tuned: bool) -> dict[str, Any]:
    """All numbers of a place and a seed."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    models = Models(place, seed, runs)
    ours = models.ours()
    others = {view: models.neighbours(view) for view in ("network", "thumbnail")} if ours.model.local else {}
    retrained = {
        "order-aware labels": models.unlabelled(),
        "the map of features": models.averaged(),
        "projection": models.unprojected(),
        "a small network (larger instead)": models.larger(),
        "frozen features (fine-tuned instead)": models.tuned() if tuned else None,
    }
    test, fixes = ours.model.split.test, {}
    found: dict[str, Any] = {
        "source": provenance()["source_revision"],
        "train_s": ours.seconds,
        "paper_train_s": models.paper().seconds,
        "retrained_s": {name: sum(one.seconds.values()) for name, one in retrained.items() if one},
    }
    for name, interval in ({"all": 0.0} if place in SPARSE else EVERY).items():
        frames = spaced(models.sequence.timestamps_s, test, interval) if interval else test
        seen = frames_of(ours, models, frames, fixes)
        paths = Paths(ours, seen, others)
        here = {
            "frames": len(frames),
            "ours": seen.error(paths.path(ALL)),
            "removed": {part: seen.error(paths.path(parts)) for part, parts in REMOVED.items()},
            "switches": {part: seen.error(paths.path(parts)) for part, parts in SWITCHES.items()},
            "steps": steps(models, seen, paths),
        }
        for part, other in retrained.items():
            if other is not None:
                here["removed"][part] = seen.error(Paths(other, seen).path(ALL))
        found[name] = here
        if not interval:
            found["regions"] = {"ours": regions(ours, seen)}
            found["regions"] |= {part: regions(other, seen) for part, other in retrained.items() if other}
            found["ms"] = milliseconds(ours, models, seen)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--places", nargs="+", default=list(PLACES), choices=PLACES)
    parser.add_argument("--runs", type=Path, default=ROOT / "ladder-out")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--tuned", action="store_true", help="also with fine-tuned networks, minutes each")
    asked = parser.parse_args()
    numbers = RESULTS / "ladder"
    numbers.mkdir(parents=True, exist_ok=True)
    wanted = {
        (p, s): numbers / f"{p.replace(', ', '-').replace(' ', '-')}-{s}.json"
        for s in asked.seeds
        for p in asked.places
    }
    with ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
        jobs = {
            pool.submit(measured, place, seed, asked.runs, tuned=asked.tuned): (place, seed)
            for (place, seed), file in wanted.items()
            if not file.is_file()
        }
        for job in as_completed(jobs):
            started, key = time.strftime("%H:%M:%S"), jobs[job]
            part = wanted[key].with_suffix(".part")
            part.write_text(json.dumps(job.result(), indent=1) + "\n")
            part.replace(wanted[key])
            print(started, *key, flush=True)
    write_tables({key: json.loads(file.read_text()) for key, file in wanted.items() if file.is_file()})


if __name__ == "__main__":
    main()
