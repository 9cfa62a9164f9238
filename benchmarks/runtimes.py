"""What runs the network: torch, ONNX Runtime, and ONNX Runtime in eight bits; time, size, sets and coverage.

python benchmarks/runtimes.py [--seeds 10 11 12]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch: times are of one core

import numpy as np
import torch
from common import DATA, mean_interval, write_table

from conformodal.conformal import coverage_band
from conformodal.core.caching import default_cache_dir
from conformodal.datasets import Sequence, read_sevenscenes
from conformodal.localization.evidence import FrameEvidence
from conformodal.localization.targets import pose_targets
from conformodal.model.config import ModelConfig, Runtime
from conformodal.model.model import PoseModel
from conformodal.model.store import save_model
from conformodal.networks import TorchBackbone
from conformodal.training.training import prepare_training_data, train_model
from conformodal.vision.backbone import Backbone
from conformodal.vision.features import FeatureCache, extract_features
from conformodal.vision.settings import TrainingConfig

N_TIMED = 100
# In a process of its own: a model that was saved, and nothing else.
START = """
import sys, time
started = time.perf_counter()
from conformodal.running import VisualOdometry
from conformodal.datasets import read_image
odometry = VisualOdometry.load(sys.argv[1])
image = read_image(sys.argv[2])
odometry.step(image, 0.0)
first = time.perf_counter() - started
for k in range(1, 60):
    odometry.step(image, k / 30)
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))  # rusage has the parent's too
print(first, int(peak.split()[1]) / 1e3)
"""


def cpu_ms(work: Callable[[int], object]) -> list[float]:
    """Milliseconds of one core, call by call."""
    torch.set_num_threads(1)
    for k in range(5):
        work(k)
    found = []
    for k in range(N_TIMED):
        started = time.process_time()
        work(k)
        found.append(1e3 * (time.process_time() - started))
    return found


def started(model: PoseModel, image: Path) -> tuple[float, float]:
    """Seconds from the start of Python to the first answer, and megabytes resident after sixty."""
    with tempfile.TemporaryDirectory() as folder:
        save_model(model, Path(folder))
        command = [sys.executable, "-c", START, folder, str(image)]
        printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return float(printed[0]), float(printed[1])


def judged(model: PoseModel, features: np.ndarray, truth: np.ndarray, spread: np.ndarray) -> tuple[float, float]:
    """Coverage of the whole pose and mean length of sets in standard deviations, of frames of known places."""
    found = model.localize(FrameEvidence(features))
    held = found.regions.contains(truth, joint=True)[found.known]
    return float(held.mean()), float((found.regions.length / spread)[found.known].mean())


def measure(sequence: Sequence, seed: int, cache: FeatureCache) -> dict[str, dict[str, float]]:
    """Numbers of each runtime."""
    config = ModelConfig(seed=seed, sources=("head", "neighbours"), training=TrainingConfig(seed=seed))
    models: dict[Runtime, PoseModel] = {}
    for runtime in (Runtime.ONNX, Runtime.INT8):
        own = replace(config, runtime=runtime)
        models[runtime] = train_model(prepare_training_data(sequence, own, cache), own)
    onnx = models[Runtime.ONNX]
    models[Runtime.TORCH] = replace(onnx, backbone=TorchBackbone(onnx.backbone.config))
    targets, test = pose_targets(sequence.require_truth(), onnx.sign_reference), onnx.split.test
    paths, spread = [sequence.image_paths[i] for i in test], targets[onnx.split.train].std(axis=0)
    images = [onnx.backbone.prepare(sequence.image(int(i))) for i in test[:20]]
    features = {r: extract_features(paths, m.backbone, cache) for r, m in models.items()}
    probabilities = {r: models[Runtime.ONNX].localizer.beliefs(FrameEvidence(features[r])).proba for r in models}
    sets = {r: models[r].localize(FrameEvidence(features[r])).regions for r in (Runtime.ONNX, Runtime.TORCH)}
    same = [
        (a == b).all(axis=1).mean() for a, b in zip(sets[Runtime.ONNX].masks, sets[Runtime.TORCH].masks, strict=True)
    ]
    found = {}
    for runtime, model in models.items():
        coverage, length = judged(model, features[runtime], targets[test], spread)
        seconds, megabytes = started(model, paths[0])
        network: Backbone = model.backbone
        known = model.localize(FrameEvidence(features[runtime])).known
        low, high = coverage_band(int((model.rules.known_p > model.rules.level).sum()), int(known.sum()), 0.1)
        found[str(runtime)] = {
            "network, ms": float(np.median(cpu_ms(lambda k, its=network: its.maps(images[k % 20][None])))),
            "network, MB": len(getattr(network, "content", b"")) / 1e6,
            "first answer, s": seconds,
            "resident, MB": megabytes,
            "coverage": coverage,
            "in band": float(low <= coverage <= high),
            "set length": length,
        }
    difference = max(
        float(np.abs(a - b).max())
        for a, b in zip(probabilities[Runtime.ONNX], probabilities[Runtime.TORCH], strict=True)
    )
    found[str(Runtime.ONNX)] |= {"largest difference of a probability": difference, "same sets": float(np.mean(same))}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[10, 11, 12])
    seeds = parser.parse_args().seeds
    sequence, cache = read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01"), FeatureCache(default_cache_dir())
    of = [measure(sequence, seed, cache) for seed in seeds]
    columns = list(of[0][str(Runtime.ONNX)])
    rows = []
    for runtime in (Runtime.TORCH, Runtime.ONNX, Runtime.INT8):
        its = [one[str(runtime)] for one in of]
        digits = {
            "largest difference of a probability": 6,
            "same sets": 5,
            "coverage": 3,
            "in band": 2,
            "set length": 4,
        }
        rows.append([str(runtime), *(mean_interval([i[c] for i in its if c in i], digits.get(c, 2)) for c in columns)])
    note = (
        f"redkitchen, `interleaved`, seeds {seeds}, alpha = 0.1 for the whole pose, sources head and neighbours; mean "
        "and 95 % interval. Network: median of one core's time for one image of 320 x 240. First answer: from the "
        "start of Python to the first pose of 640 x 480 pixels. torch: the model of ONNX with its network in torch; "
        "differences and same sets (target by target) are between these two. int8: all learnt and calibrated anew. "
        "Coverage and length (standard deviations, mean of seven targets): test frames of known places; frames were "
        "split at random, so calibration and test frames are exchangeable; in band: share of the seeds whose coverage "
        "lies in the central 99 % of its Beta-binomial law."
    )
    write_table("runtimes", "What runs the network", "python benchmarks/runtimes.py", ["runtime", *columns], rows, note)


if __name__ == "__main__":
    main()
