"""Accept or abstain: our reliable poses, and place recognition whose acceptance is calibrated.

python benchmarks/accept.py [--seed 40]     # after cameras.py and unseen.py, whose models and numbers it uses

The peer names the position of the most similar known image and accepts it by the rule of SafeVPR (arXiv 2605.28048,
from its abstract): mutual nearest neighbours among local features as the score, and learn-then-test thresholds of that
score, Bonferroni-corrected, in bins of the score. Its features are XFeat's instead of DINOv2's.
"""

from __future__ import annotations

import os
from functools import partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from cameras import unit
from common import DATA, REDKITCHEN, RUNS, SEEDS, cached_json, parser_of, part_of, write_table
from scipy.stats import binom
from unseen import KNOWN, KNOWN_SHARE, REST, all_runs
from worlds import ALPHA, CACHE, FAR_M

from conformodal.core.arrays import BoolArray, IntArray
from conformodal.features.local import Detector, LocalFeatures, match
from conformodal.features.networks import make_detector
from conformodal.io import Recording, SplitKind, make_split, read_recording
from conformodal.io.splits import held_out_together
from conformodal.tracking.motions import run_front_end

DELTA, LEVELS = 0.1, 10  # probability that the peer's guarantee fails; thresholds that are tested in each bin
BINS = {"one bin": 1, "four bins": 4}
WORLD = "fr1_desk from fr1_xyz"


def features_of(recording: Recording, frames: IntArray, detector: Detector) -> list[LocalFeatures]:
    """Local features and global descriptor of each frame."""
    found = run_front_end(recording, frames, detector, motions=False).features
    return [found[i] for i in frames.tolist()]


def retrieved(
    asked: list[LocalFeatures], known: list[LocalFeatures], hidden: BoolArray | None = None
) -> tuple[IntArray, IntArray]:
    """The most similar known image (m,) of each image asked, without the `hidden` (m, n) ones, and its score (m,).

    The score is the number of mutual nearest neighbours.
    """
    cosines = np.array([a.global_descriptor for a in asked]) @ np.array([k.global_descriptor for k in known]).T
    if hidden is not None:
        cosines[hidden] = -np.inf
    best = cosines.argmax(axis=1)
    pairs = [(image.descriptors, known[k].descriptors) for image, k in zip(asked, best.tolist(), strict=True)]
    return best, np.array([len(match(one, [other])[0]) for one, other in pairs])


def accepted(scores: IntArray, calibration: IntArray, right: BoolArray, n_bins: int) -> BoolArray:
    """Learn then test (Angelopoulos et al. 2021) in each bin: at most ALPHA of what is accepted is wrong."""
    edges = np.quantile(calibration, np.arange(1, n_bins) / n_bins)
    of_calibration, of_asked = (np.searchsorted(edges, each, "right") for each in (calibration, scores))
    result = np.zeros(len(scores), dtype=bool)
    for number in range(n_bins):
        mine = of_calibration == number
        levels = np.quantile(calibration[mine], np.linspace(0, 0.9, LEVELS)) if mine.any() else np.empty(0)
        for level in np.unique(levels).tolist():  # from the lowest: the first that passes accepts most
            above = mine & (calibration >= level)
            p_value = binom.cdf((above & ~right).sum(), above.sum(), ALPHA)
            if p_value <= DELTA / (LEVELS * n_bins):
                result |= (of_asked == number) & (scores >= level)
                break
    return result


def peers(known: Recording, known_frames: IntArray, asked: Recording, asked_frames: IntArray) -> dict[str, Any]:
    """Whether each frame asked is accepted, by number of bins, and whether what is named is right."""
    detector = make_detector("xfeat", known.camera)
    map_images, images = features_of(known, known_frames, detector), features_of(asked, asked_frames, detector)
    stretch = held_out_together(known.recording, SplitKind.BLOCKS)[known_frames]
    best, calibration = retrieved(map_images, map_images, stretch[:, None] == stretch)
    found, scores = retrieved(images, map_images)
    positions = known.require_truth()[np.searchsorted(known.posed, known_frames)].positions_xyz
    truth = asked.require_truth()[np.searchsorted(asked.posed, asked_frames)].positions_xyz
    of_map = np.linalg.norm(positions[best] - positions, axis=1) <= FAR_M
    right = np.linalg.norm(positions[found] - truth, axis=1) <= FAR_M
    by_bins = {name: accepted(scores, calibration, of_map, n).tolist() for name, n in BINS.items()}
    return {"right": right.tolist(), "accepted": by_bins}


def ours(run: dict[str, Any]) -> dict[str, Any]:
    """The same of our poses, which are accepted where they are reliable."""
    reliable = run["reliable"] if "reliable" in run else [not flagged for flagged in run["flagged"]]
    return {"right": [off <= FAR_M for off in run["off_m"]], "accepted": {"reliable poses": reliable}}


def of_desk(seed: int) -> dict[str, dict[str, Any]]:
    """fr1_desk by what fr1_xyz shows, of which it shows little."""
    xyz, desk = (read_recording(DATA / "tum" / name) for name in ("fr1_xyz", "fr1_desk"))
    mine = ours(unit(WORLD, seed, "ours")["frames"]["smoothed"])
    return {"ours": mine, "peer": peers(xyz, xyz.posed, desk, desk.posed)}


def of_kitchen(seed: int) -> dict[str, dict[str, dict[str, Any]]]:
    """The test part of what is known of redkitchen, and the rest."""
    video = read_recording(REDKITCHEN)
    mapped, rest = np.split(np.arange(len(video)), [int(KNOWN_SHARE * len(video))])
    file = RUNS / "unseen" / f"redkitchen-{seed}.json"
    runs = cached_json(file, partial(all_runs, "redkitchen", seed, CACHE))["blocks, stretches"]
    known = part_of(video, mapped)
    split = make_split(known.recording, SplitKind.BLOCKS, seed=seed)
    used = np.sort(np.concatenate((split.train, split.calibration)))
    asked = {KNOWN: (known, split.test), REST: (part_of(video, rest), np.arange(len(rest)))}
    return {
        name: {"ours": ours(runs[name]), "peer": peers(known, used, recording, frames)}
        for name, (recording, frames) in asked.items()
    }


def measured(seed: int) -> dict[str, Any]:
    """Both systems, by what is asked."""
    return {WORLD: of_desk(seed)} | {f"redkitchen: {name}": each for name, each in of_kitchen(seed).items()}


def cells(right: BoolArray, taken: BoolArray) -> list[str]:
    """Shares of accepted frames, of frames that are accepted and right, and of wrong and of right ones."""
    wrong = f"{np.mean(~right[taken]):.3f}" if taken.any() else ""
    of_right = f"{np.mean(taken[right]):.3f}" if right.any() else ""
    return [f"{taken.mean():.3f}", f"{np.mean(taken & right):.3f}", wrong, of_right]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--seed", type=int, default=SEEDS[0])
    seed = parser.parse_args().seed
    rows = []
    for asked, systems in cached_json(RUNS / "accept" / f"{seed}.json", partial(measured, seed)).items():
        for system, name in (("ours", ""), ("peer", "place recognition, ")):
            right = np.array(systems[system]["right"])
            for how, taken in systems[system]["accepted"].items():
                rows.append([asked, name + how, str(len(right)), *cells(right, np.array(taken))])
    header = ["asked", "system", "n", "accepted", "accepted and right", "wrong, of accepted", "accepted, of right"]
    note = (
        f"alpha = {ALPHA}; seed {seed}. Right: the position is within {FAR_M} m of the truth. Ours: the pose after "
        "all frames is accepted where it is reliable; models of cameras.md and unseen.md (`blocks`), whose settings "
        "were chosen on these recordings with other seeds. Place recognition: the position of the most similar known "
        "image, accepted where the number of mutual nearest neighbours (XFeat, as the package matches them) reaches "
        f"its threshold. Thresholds: learn then test at {ALPHA} with probability {1 - DELTA}, Bonferroni over {LEVELS} "
        "thresholds and all bins of the score; every known image is scored without its own stretch. Rule of SafeVPR, "
        "from its abstract; its code and DINOv2 were not used. Neither guarantee holds for another recording or "
        "unknown parts."
    )
    command = f"python benchmarks/accept.py --seed {seed}"
    write_table("accept", "Accept or abstain", command, header, rows, note)


if __name__ == "__main__":
    main()
