"""Ablation: from the paper's system to ours, one change at a time; and ours with one part left out at a time.

python benchmarks/ablation.py [--seeds 10 11 12 13 14] [--places ...] [--runs FOLDER] [--workers 2]

Models are cached in the folder of runs, numbers in benchmarks/results/ablation: what is there is not computed again.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: two trainings side by side

import cv2
import matplotlib as mpl
import numpy as np
import torch
from common import (
    DATA,
    REDKITCHEN,
    RESULTS,
    ROOT,
    SEEDS,
    cached_json,
    half_width,
    mean_interval,
    seconds_of,
    table_lines,
    without_limits,
    without_rotation,
    write_page,
)
from joblib import Parallel, delayed

from conformodal.cli.demo import N_LAPS, N_MODULES, TRAINING
from conformodal.conformal import SplitConformal
from conformodal.core.arrays import FloatArray, IntArray
from conformodal.core.files import default_cache_dir
from conformodal.corridor.writer import write_corridor
from conformodal.features.backbone import BackboneConfig, feature_views
from conformodal.features.extract import FeatureCache
from conformodal.features.local import LocalFeatures, Matcher, extract_local_features
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, trajectory_errors
from conformodal.io import Recording, SplitKind, read_recording, read_sevenscenes
from conformodal.localizer.candidates import interval_runs
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import filter_posteriors, hindsight_posteriors
from conformodal.localizer.greedy import greedy
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.observations import Observations, PosePath
from conformodal.localizer.places import choose_places, own_hypotheses
from conformodal.localizer.region_rules import RegionRules
from conformodal.localizer.smoother import smooth
from conformodal.localizer.sources.landmarks import LandmarkSource
from conformodal.localizer.sources.source_data import SourceData
from conformodal.localizer.targets import pose_targets
from conformodal.pipeline.calibrate import score_beliefs
from conformodal.pipeline.config import Calibration, ModelConfig
from conformodal.pipeline.model import Localization, PoseModel
from conformodal.pipeline.paper_odometry import PaperOdometry
from conformodal.pipeline.results.provenance import provenance
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import prepare_training_data, train_model
from conformodal.tracking.frontend import EssentialFrontEnd
from conformodal.tracking.motions import MotionRecord, measure_motions

mpl.use("Agg")
from matplotlib import pyplot as plt

Numbers = dict[tuple[str, int], dict[str, Any]]  # by place and seed

ALPHA = 0.1
KITCHENS = ("redkitchen, interleaved", "redkitchen, blocks")
SPARSE = ("TUM cabinet", "KITTI 06")  # too few frames to take fewer
PLACES = (*KITCHENS, "corridor", *SPARSE)
EVERY = {"1/6 s": 0.0, "1 s": 1.0, "3 s": 3.0}  # a fifth of 30 frames per second: a sixth of a second apart
INTERVALS = (*EVERY, "all")
SMALL = 0.03  # a part that changes an error by less is worth nothing there

# ---- parts, and what is measured with and without them


@dataclass(frozen=True)
class Parts:
    """Parts that are used; all of them by default."""

    landmarks: bool = True
    submaps: bool = True
    rotations: bool = True
    limits: bool = True
    posterior: str = "hindsight"  # "hindsight" from all frames, "online" from those so far, "frame" from each alone
    smoother: bool = True


ALL = Parts()
BARE = Parts(landmarks=False, submaps=False, smoother=False)
POSTERIOR = "posterior (each frame's most probable hypothesis)"
REMOVED = {
    "landmarks": replace(ALL, landmarks=False),
    "submaps": replace(ALL, submaps=False),
    "relative rotations": replace(ALL, rotations=False),
    "limits on speed and turning": replace(ALL, limits=False),
    "limits and relative rotations": replace(ALL, limits=False, rotations=False),
    POSTERIOR: replace(ALL, posterior="frame"),
    "later frames (the filter alone)": replace(ALL, posterior="online"),
    "smoother": replace(ALL, smoother=False),
}
RETRAINED = {  # by what is left out: the model without it
    "order-aware labels": "one-hot",
    "the map of features": "averaged",
    "projection": "unprojected",
    "a small network (larger instead)": "larger",
}
# Limits and relative rotations, each with and without, on all evidence and on the softmax alone.
SWITCHES = {
    f"{evidence}, {limits}, {motion}": replace(start, limits=limits == "limits", rotations=motion == "rotations")
    for evidence, start in (("all evidence", ALL), ("softmax alone", replace(BARE, smoother=True)))
    for limits in ("limits", "no limits")
    for motion in ("rotations", "no rotations")
}
STEPS = {  # from the posterior on, each with one part more than the one before
    "modes of the softmax, posterior over them": replace(BARE, limits=False),
    "limits on speed and turning": BARE,
    "landmarks": replace(BARE, landmarks=True),
    "smoother": replace(BARE, landmarks=True, smoother=True),
    "submaps: ours": ALL,
}
# Files, stages of training and times per frame that belong to one part alone.
FILES = {
    "landmarks": ["localization/landmarks/*.py", "localization/local_features.py"],
    "submaps": ["motion/submaps.py", "motion/bundle.py", "poses/submap.py", "reasoning/submap_alignment.py"],
    "relative rotations": ["motion/relative_pose.py", "motion/two_view.py", "motion/tracker.py", "motion/frontend.py"],
    "limits on speed and turning": ["reasoning/prior.py"],
    POSTERIOR: ["reasoning/filter.py", "reasoning/places.py"],
    "smoother": ["reasoning/smoother.py", "reasoning/orientations.py"],
    "projection": ["vision/projection.py"],
}
STAGES = {"landmarks": ("local features", "landmarks")}
TIMES = {**STAGES, POSTERIOR: ("posterior",), "smoother": ("smoother",)}


# ---- models


def config_of(place: str, seed: int, model: str = "ours") -> ModelConfig | None:
    """Settings of a model; None where it is ours anyway or is not measured. Frames calibrate in both splits."""
    training = replace(TRAINING, seed=seed) if place == "corridor" else TrainingConfig(seed=seed)
    split = SplitKind.BLOCKS if place.endswith("blocks") else SplitKind.INTERLEAVED
    ours = ModelConfig(seed=seed, split=split, alpha=ALPHA, training=training, calibrate_on=Calibration.FRAMES)
    whole = replace(training, components=None)
    labels = {"margin": 0.0, "sigma_bins": 0.0, "score": "lac", "joint": "none"}
    softmax = {**labels, "novelty_level": 0.0, "sources": ("head",)}
    match model:
        case "paper":
            return ModelConfig.paper(seed=seed, split=split, alpha=ALPHA, training=training)
        case "map":
            return replace(ours, training=whole, **softmax)
        case "projected":
            return None if training.components is None else replace(ours, **softmax)
        case "one-hot":
            return replace(ours, sigma_bins=0.0)
        case "unprojected":
            return None if training.components is None else replace(ours, training=whole)
        case "stretches":
            return replace(ours, calibrate_on=Calibration.STRETCHES)
        case "larger":
            return replace(ours, network="efficientnet_lite2") if place in KITCHENS else None
    return ours


def averaged(features: np.ndarray) -> np.ndarray:
    """Features (n, F) whose map is its mean over the image everywhere."""
    views = feature_views(features.shape[1])
    rows, columns = BackboneConfig.grid
    network = features[:, views.network].reshape(len(features), -1, rows * columns)
    flat = np.broadcast_to(network.mean(axis=2, keepdims=True), network.shape).reshape(len(features), -1)
    return np.concatenate((flat, features[:, views.thumbnail]), axis=1)


def name_of(place: str, seed: int) -> str:
    return f"{place.replace(', ', '-').replace(' ', '-')}-{seed}"


class Stages:
    """Seconds by stage, from calls of a progress function."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._since = "features", time.perf_counter()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """A call of the progress function."""
        now = time.perf_counter()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now


@dataclass(frozen=True)
class Trained:
    """A model, the features that it sees of all frames, and the seconds of its stages of training."""

    model: PoseModel
    features: np.ndarray
    seconds: dict[str, float]

    def proba(self, frames: IntArray) -> list[np.ndarray]:
        """Softmaxes of some frames."""
        return self.model.localizer.beliefs(FrameEvidence(self.features[frames])).proba


class Models:
    """All models of a place and a seed, cached in a folder of `runs`."""

    def __init__(self, place: str, seed: int, runs: Path) -> None:
        self.place, self.seed, self.folder = place, seed, runs / name_of(place, seed)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.sequence = self._sequence()
        self.cache = FeatureCache(self.folder if place == "corridor" else default_cache_dir())
        self._local_features: dict[int, LocalFeatures] = {}
        self._matcher, self._fit_landmarks = Matcher(), LandmarkSource.fit
        self._maps: dict[bytes, LandmarkSource | None] = {}

    def _sequence(self) -> Recording:
        if self.place in KITCHENS:
            return read_sevenscenes(REDKITCHEN)
        if self.place in SPARSE:
            own = {"TUM cabinet": DATA / "tum" / "fr3_cabinet", "KITTI 06": DATA / "kitti" / "sequences" / "06"}
            return read_recording(own[self.place])
        if not (self.folder / "world.done").is_file():
            write_corridor(self.folder / "world", n_modules=N_MODULES, n_laps=N_LAPS, seed=self.seed)
            (self.folder / "world.done").touch()
        return read_sevenscenes(self.folder / "world")

    def trained(self, name: str) -> Trained | None:
        """A model by the name of its settings."""
        config, folder, stages = config_of(self.place, self.seed, name), self.folder / name, Stages()
        if config is None:
            return None
        data = prepare_training_data(self.sequence, config, self.cache, stages)
        if name == "averaged":
            data = replace(data, features=averaged(data.features))
        if not (folder / "seconds.json").is_file():
            data._shared._local_features, data._shared.matcher = self._local_features, self._matcher
            with patch.object(LandmarkSource, "fit", self._landmarks):
                model = train_model(data, config, progress=stages)
            stages("end", 0, 0)
            save_model(model, folder)
            (folder / "seconds.json").write_text(json.dumps(stages.seconds))
        return Trained(load_model(folder), data.features, json.loads((folder / "seconds.json").read_text()))

    @property
    def ours(self) -> Trained:
        """The complete system."""
        found = self.trained("ours")
        assert found is not None
        return found

    def _landmarks(self, data: SourceData, frames: IntArray) -> LandmarkSource | None:
        """A map does not depend on the network: the models of a place and seed share those of the same frames."""
        key = frames.tobytes()
        if key not in self._maps:
            self._maps[key] = self._fit_landmarks(data, frames)
        return self._maps[key]


# ---- paths of a model


class Frames:
    """The frames of a recording that are answered, and their relative motion."""

    def __init__(self, sequence: Recording, test: IntArray, interval_s: float = 0.0) -> None:
        self.sequence = sequence
        self.frames = spaced(sequence.timestamps_s, test, interval_s) if interval_s else test
        self.motions = measure_motions(sequence, self.frames)
        self.times, self.truth = sequence.timestamps_s[self.frames], sequence.require_truth()[self.frames]
        self.relative = [self.motions.motions[i] for i in self.frames.tolist()]

    def error(self, path: PosePath | Trajectory) -> list[float]:
        """RMSE in metres and degrees."""
        off = trajectory_errors(Trajectory(self.times, path.positions_xyz, path.orientations_quat_wxyz), self.truth)
        return [off["rmse_m"], off["rmse_deg"]]


def spaced(times: FloatArray, frames: IntArray, interval_s: float) -> IntArray:
    """Of some frames those that follow each other after an interval or more."""
    chosen = [int(frames[0])]
    for i in frames[1:].tolist():
        if times[i] >= times[chosen[-1]] + interval_s - 1e-6:
            chosen.append(i)
    return np.array(chosen)


class Paths:
    """Paths of a trained model over some frames, with chosen parts."""

    def __init__(self, trained: Trained, seen: Frames) -> None:
        self.trained, self.seen = trained, seen
        local = [seen.motions.local_features[i] for i in seen.frames.tolist()]
        self.evidence = FrameEvidence(trained.features[seen.frames], local)
        self._cached: dict[bool, Localization] = {}

    def path(self, parts: Parts) -> PosePath:
        """The path with the chosen parts."""
        model, seen, found = self.trained.model, self.seen, self.localization(parts)
        prior = model.prior if parts.limits else without_limits(model.prior)
        motions = seen.relative if parts.rotations else [without_rotation(m) for m in seen.relative]
        submaps = seen.motions.submaps_of(seen.frames) if parts.submaps else []
        given = Observations(found.candidates, motions, seen.times, submaps, found.known | found.beliefs.recognised)
        if parts.posterior == "frame":
            best = [int(np.argmax(c.log_mass)) for c in given.candidates]
            chosen = PosePath.choose(given.candidates, given.timestamps_s, best)
        else:
            posteriors = (hindsight_posteriors if parts.posterior == "hindsight" else filter_posteriors)(given, prior)
            chosen, _ = choose_places(posteriors, given.timestamps_s, prior)
        return smooth(own_hypotheses(chosen, given, prior), given, prior) if parts.smoother else chosen

    def localization(self, parts: Parts) -> Localization:
        """Answers of the chosen pose sources, frame by frame."""
        if parts.landmarks not in self._cached:
            model = self.trained.model
            sources = tuple(s for s in model.localizer.sources if parts.landmarks or s.name != "landmarks")
            localizer = Localizer(sources, model.bins, model.sign_reference)
            model = replace(model, localizer=localizer) if localizer.local else self._without_landmarks(localizer)
            self._cached[parts.landmarks] = model.localize(self.evidence)
        return self._cached[parts.landmarks]

    def _without_landmarks(self, localizer: Localizer) -> PoseModel:
        """The model with a localizer that uses no local features, calibrated by its answers to the held-out frames."""
        model, features = self.trained.model, self.trained.features[self.trained.model.split.calibration]
        truth, own, novelty = self.seen.sequence.require_truth(), copy(model.calibration), model.novelty
        targets = pose_targets(truth, model.sign_reference)[model.split.calibration]
        scores = score_beliefs(own, localizer, localizer.beliefs(FrameEvidence(features)), targets)
        p = np.ones(len(features)) if novelty is None else novelty.p_values(features)
        rules = RegionRules(own.calibrate_scores(scores), None, p, model.rules.level)
        if novelty is not None:
            novelty = replace(novelty, matched=None, disturbed=None)
        return replace(model, localizer=localizer, rules=rules, novelty=novelty, quality=None)

    def greedy(self, rule: SplitConformal | None = None, motions: MotionRecord | None = None) -> PosePath:
        """The paper's reasoning over regions of the softmax alone, by the model's own rule or one over its bins."""
        if rule is None:
            found = self.localization(BARE)
            intervals = interval_runs(self.trained.model.localizer.marginals(found.beliefs), found.regions)
        else:
            proba = self.trained.proba(self.seen.frames)
            intervals = interval_runs(proba, rule.predict(proba))
        record = motions or self.seen.motions
        return greedy(intervals, [record.motions[i] for i in self.seen.frames.tolist()], self.seen.times)


# ---- numbers of a place and a seed


def first_steps(models: Models, seen: Frames, ours: Paths) -> dict[str, list[float]]:
    """Errors from the paper's system to the filter, each with one change more than the one before."""
    paper, model = models.trained("paper"), ours.trained.model
    assert paper is not None
    front_end = EssentialFrontEnd(models.sequence.camera)
    essential = measure_motions(models.sequence, seen.frames, front_end=front_end, local=False)
    run = PaperOdometry(paper.model).process(models.sequence, seen.frames, cache=models.cache, motions=essential)
    found = {"the paper's system": seen.error(run.trajectories["greedy"])}
    steps = {"a map of features instead of their average": "map", "projection on principal components": "projected"}
    for step, name in steps.items():
        trained = models.trained(name)
        if trained is not None:
            found[step] = seen.error(Paths(trained, seen).greedy(motions=essential))
    targets, held_out = pose_targets(models.sequence.require_truth(), model.sign_reference), model.split.calibration
    lac = SplitConformal(model.bins, ALPHA, "lac", "none")
    lac.calibrate(ours.trained.proba(held_out), targets[held_out])
    found["order-aware labels, bins with a margin"] = seen.error(ours.greedy(lac, essential))
    found["score by density, one threshold for the pose"] = seen.error(ours.greedy(motions=essential))
    found["relative motion by PoseLib"] = seen.error(ours.greedy())
    return found


def regions(trained: Trained, seen: Frames) -> dict[str, Any]:
    """Coverage of the whole pose and mean length of the position's sets in standard deviations, known frames only."""
    model, paths = trained.model, Paths(trained, seen)
    targets, held_out = pose_targets(seen.sequence.require_truth(), model.sign_reference), model.split.calibration
    spread, truth = targets[model.split.train].std(axis=0), targets[seen.frames]
    lac = SplitConformal(model.bins, ALPHA, "lac", "max")
    lac.rule.keep_scale()  # probabilities of all targets are on one scale
    lac.calibrate(trained.proba(held_out), targets[held_out])
    localized = paths.localization(ALL)
    found, known = {"lac": lac.predict(localized.beliefs.proba), "all": localized.regions}, localized.known
    return {
        name: [float(r.contains(truth, joint=True)[known].mean()), float((r.length / spread)[known, :3].mean())]
        for name, r in found.items()
    }


def milliseconds(trained: Trained, models: Models, seen: Frames) -> dict[str, float]:
    """Milliseconds per frame of the parts that the table gives a cost of."""
    model, paths = trained.model, Paths(trained, seen)
    image, n = models.sequence.image(int(seen.frames[0])), len(seen.frames)
    chosen, found, evidence = paths.path(ALL), paths.localization(ALL), paths.evidence
    given = Observations(found.candidates, seen.relative, seen.times, [])

    def ms(work: Callable[[], object], count: int = n) -> float:
        work()
        return 1e3 * seconds_of(work) / count

    return {
        "local features": ms(lambda: extract_local_features(image, models.sequence.camera), 1),
        **{s.name: ms(partial(s.answer, evidence)) for s in model.localizer.sources},
        "posterior": ms(lambda: hindsight_posteriors(given, model.prior)),
        "smoother": ms(lambda: smooth(chosen, given, model.prior)),
    }


def measured(place: str, seed: int, runs: Path) -> dict[str, Any]:
    """All numbers of a place and a seed."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    models = Models(place, seed, runs)
    ours = models.ours
    retrained = {part: one for part, name in RETRAINED.items() if (one := models.trained(name)) is not None}
    found: dict[str, Any] = {
        "source": provenance()["source_revision"],
        "train_s": ours.seconds,
    }
    for name, interval in ({"all": 0.0} if place in SPARSE else EVERY).items():
        seen = Frames(models.sequence, ours.model.split.test, interval)
        paths = Paths(ours, seen)

        def errors(of: dict[str, Parts], paths: Paths = paths, seen: Frames = seen) -> dict[str, list[float]]:
            return {part: seen.error(paths.path(parts)) for part, parts in of.items()}

        without = {part: seen.error(Paths(one, seen).path(ALL)) for part, one in retrained.items()}
        found[name] = {
            "frames": len(seen.frames),
            "ours": seen.error(paths.path(ALL)),
            "removed": errors(REMOVED) | without,
            "switches": errors(SWITCHES),
            "steps": first_steps(models, seen, paths) | errors(STEPS),
        }
        if not interval:
            found["regions"] = {part: regions(one, seen) for part, one in {"ours": ours, **retrained}.items()}
            found["ms"] = milliseconds(ours, models, seen)
    return found


# ---- tables


def conditions(numbers: Numbers) -> list[tuple[str, str]]:
    """Places and intervals that were measured, in order."""
    places = dict.fromkeys(place for place, _ in numbers)
    return [(p, i) for p in places for i in INTERVALS if any(i in one for (q, _), one in numbers.items() if q == p)]


def names_of(numbers: Numbers, key: str) -> list[str]:
    return list(dict.fromkeys(n for one in numbers.values() for i in INTERVALS for n in one.get(i, {}).get(key, {})))


def over_seeds(numbers: Numbers, at: tuple[str, str], key: str, name: str, unit: int = 0) -> list[float]:
    """Errors of a condition, seed by seed: metres, or degrees with `unit` 1; relative to ours of parts left out."""
    here = [one[at[1]] for (place, _), one in numbers.items() if place == at[0] and at[1] in one]
    base = [one["ours"][unit] if key == "removed" else 1 for one in here]
    return [one[key][name][unit] / b for one, b in zip(here, base, strict=True) if name in one[key]]


def ratio_of(values: list[float]) -> tuple[float, float, float] | None:
    """Geometric mean of ratios and its 95 % interval."""
    if not values:
        return None
    logs = np.log(values)
    mean, half = logs.mean(), half_width(logs.tolist())
    return tuple(float(np.exp(v)) for v in (mean, mean - half, mean + half))  # type: ignore[return-value]


def ratio_cell(values: list[float]) -> str:
    mean, low, high = ratio_of(values) or (np.nan,) * 3
    return "" if np.isnan(mean) else f"{mean:.2f}" if np.isnan(low) else f"{mean:.2f} ({low:.2f} to {high:.2f})"


def worthless(numbers: Numbers, *, surely: bool) -> list[str]:
    """Parts whose removal raises no error by more than ``SMALL``; with `surely`, no lower end of its interval."""
    lines = []
    for part in names_of(numbers, "removed"):
        each = [over_seeds(numbers, at, "removed", part, unit) for at in conditions(numbers) for unit in (0, 1)]
        ratios = [ratio for values in each if (ratio := ratio_of(values))]
        worst = max((low if surely and not np.isnan(low) else mean for mean, low, _ in ratios), default=np.inf)
        if worst <= 1 + SMALL:
            lines.append(f"- {part}: {min(r[0] for r in ratios):.2f} to {max(r[0] for r in ratios):.2f}")
    return lines


def costs(numbers: Numbers, part: str) -> list[str]:
    """Lines of source, seconds of training and milliseconds per frame of a part: medians over seeds."""
    files = [f for pattern in FILES.get(part, []) for f in (ROOT / "src" / "conformodal").glob(pattern)]
    lines = sum(len(f.read_text(encoding="utf-8").splitlines()) for f in files)
    here = [one for (place, _), one in numbers.items() if place == KITCHENS[0]]
    spent = [
        [sum(one[key].get(name, 0.0) for name in of.get(part, ())) for one in here]
        for key, of in (("train_s", STAGES), ("ms", TIMES))
    ]
    cells = (f"{np.median(v):.{digits}f}" if v and max(v) else "" for v, digits in zip(spent, (0, 1), strict=True))
    return [str(lines or ""), *cells]


def region_rows(numbers: Numbers) -> list[list[str]]:
    labels = {"all": "all sources", "lac": "softmax alone, score `lac`"}
    rows = []
    for name in dict.fromkeys(n for one in numbers.values() for n in one["regions"]):
        for key, label in labels.items():
            cells = []
            for place in dict.fromkeys(place for place, _ in numbers):
                here = [one["regions"] for (p, _), one in numbers.items() if p == place and name in one["regions"]]
                lengths = [r[name][key][1] for r in here if np.isfinite(r[name][key][1])]
                covered = f"{np.mean([r[name][key][0] for r in here]):.3f}" if here else ""
                cells.append(f"{covered}, {np.mean(lengths):.3f}" if lengths else covered)
            if key != "lac" or name == "ours":
                rows.append([name if name == "ours" else f"ours without {name}", label, *cells])
    return rows


def draw(numbers: Numbers) -> None:
    """Errors along the steps, one line per condition."""
    mpl.rcParams.update({"svg.hashsalt": "ablation", "svg.fonttype": "none", "font.size": 9})
    names, places = names_of(numbers, "steps"), list(dict.fromkeys(place for place, _ in conditions(numbers)))
    styles = dict(zip(INTERVALS, ("-", "--", ":", "-."), strict=True))
    figure, axis = plt.subplots(figsize=(10, 5), layout="constrained")
    for place, interval in conditions(numbers):
        values = {k: over_seeds(numbers, (place, interval), "steps", name) for k, name in enumerate(names)}
        means = {k: float(np.exp(np.mean(np.log(v)))) for k, v in values.items() if v}
        look = {"marker": ".", "color": f"C{places.index(place)}", "label": f"{place}, {interval}"}
        axis.plot(list(means), list(means.values()), styles[interval], **look)
    axis.set(yscale="log", ylabel="RMSE of positions (m)", xticks=range(len(names)))
    axis.set_xticklabels(names, rotation=35, ha="right", fontsize=8)
    axis.grid(axis="y", alpha=0.3)
    axis.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False, fontsize=7)
    figure.savefig(ROOT / "docs" / "images" / "ablation.svg", metadata={"Date": None})


def write_tables(numbers: Numbers) -> None:
    """``benchmarks/results/ablation.md`` and ``docs/images/ablation.svg``."""
    wanted, parts = conditions(numbers), sorted(names_of(numbers, "removed"))
    header = [f"{place}, {interval}" for place, interval in wanted]
    n_frames = [sorted({one[i]["frames"] for (q, _), one in numbers.items() if q == p}) for p, i in wanted]

    def means(key: str) -> list[list[str]]:
        names = names_of(numbers, key)
        return [[name, *(mean_interval(over_seeds(numbers, at, key, name)) for at in wanted)] for name in names]

    def ratios(part: str, unit: int = 0) -> list[str]:
        return [part, *(ratio_cell(over_seeds(numbers, at, "removed", part, unit)) for at in wanted)]

    seeds, sources = sorted({s for _, s in numbers}), sorted({one["source"] for one in numbers.values()})
    frames_row = ["test frames", *(", ".join(map(str, its)) for its in n_frames)]
    costly = [[*ratios(part), *costs(numbers, part)] for part in parts]
    content: list[str | list[str]] = [
        "Position RMSE in metres, mean over seeds and 95 % interval (Student's t). Each row has one change more than "
        "the row above it.",
        table_lines(["system", *header], [frames_row, *means("steps")]),
        "## Ours with one part left out",
        "Position error without the part over the error with it: geometric mean over seeds and 95 % interval. Lines: "
        "of files that are there for the part alone. Seconds of training and milliseconds per frame: on redkitchen, "
        "`interleaved`, one core, medians over seeds.",
        table_lines(["left out", *header, "lines", "s of training", "ms per frame"], costly),
        "The same of orientation errors:",
        table_lines(["left out", *header], [ratios(part, 1) for part in parts]),
        f"Parts whose removal raises no error of position or orientation by more than {100 * SMALL:.0f} %, and the "
        "least and the largest ratio over all columns:",
        worthless(numbers, surely=False),
        "Parts for which no column's whole interval lies above that (with few seeds intervals are wide, so that such a "
        "part may still be worth something):",
        worthless(numbers, surely=True),
        "## Limits and relative rotations",
        "Position RMSE of the smoothed path, metres. Limits are those on speed and turning.",
        table_lines(["evidence, limits, relative rotations", *header], means("switches")),
        "## Regions",
        "Whole pose covered (guaranteed: 0.9 on `interleaved`, nothing on `blocks`), and mean length of the position's "
        "sets in standard deviations; frames that show a known place; means over seeds.",
        table_lines(["model", "region from", *dict.fromkeys(place for place, _ in numbers)], region_rows(numbers)),
        f"Seeds {', '.join(map(str, seeds))} of split, training and corridor; no value of a "
        f"setting was chosen on them. Measured with source {', '.join(sources)}. "
        "Test frames, a fifth of all: all of them (1/6 s, all), "
        "or those that follow each other after 1 s or 3 s. The tracker always sees the frames between. Frames "
        "calibrate in both splits. "
        "Errors on redkitchen are against KinectFusion's poses, which differ by 4.9 cm from the other published "
        "reference (two_truths.md): differences of millimetres say how two systems agree with one reference. TUM "
        "cabinet (58 frames) and KITTI 06 (51) have 12 test frames or fewer.",
    ]
    write_page("ablation", "From the paper's system to ours", shlex.join(["python", *sys.argv]), *content)
    draw(numbers)


def store(file: Path, *of: Any) -> str:
    """Measure one place with one seed."""
    cached_json(file, partial(measured, *of))
    return file.stem


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--places", nargs="+", default=list(PLACES), choices=PLACES)
    parser.add_argument("--runs", type=Path, default=ROOT / "ablation-out")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    wanted = {(p, s): RESULTS / "ablation" / f"{name_of(p, s)}.json" for s in asked.seeds for p in asked.places}
    jobs = (delayed(store)(file, *key, asked.runs) for key, file in wanted.items() if not file.is_file())
    for name in Parallel(asked.workers, return_as="generator_unordered", batch_size=1)(jobs):
        print(time.strftime("%H:%M:%S"), name, flush=True)
    write_tables({key: json.loads(file.read_text()) for key, file in wanted.items()})


if __name__ == "__main__":
    main()
