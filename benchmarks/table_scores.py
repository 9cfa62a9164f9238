"""Scores on the default learner's densities: size, coverage, and coverage of the rows that are hardest to predict.

python benchmarks/table_scores.py
"""

from __future__ import annotations

import heapq
import time
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from common import RUNS, cached_json, parser_with_seeds, write_page
from sklearn.ensemble import RandomForestRegressor
from smooth_member import TABLES, data

from common import table_lines  # isort: skip
from conformodal.conformal import ConformalRegressor, QuantileBins, SplitConformal
from conformodal.conformal.density import mixture
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray

SEEDS = (40, 41, 42)  # settings were chosen on 10 to 29
ALPHA, TRAIN, CAL, TEST = 0.1, 800, 400, 1000
MASSES = 100  # units of probability in the dynamic programme
_ROWS = 100  # of the dynamic programme at once
OWN, DENSITY, CHOSEN = "density, own kernel", "density", "auto"


class VolumeOptimal:
    """CP-DP (arXiv 2502.16658): nested unions of at most k intervals around one of minimal length.

    Of the unions of k intervals with probability 1 - alpha, dynamic programming over bins finds the shortest. It grows
    and shrinks bin by bin at the ends of its intervals, the likeliest first; a bin scores the probability of the
    smallest union that holds it.
    """

    def __init__(self, k: int) -> None:
        self.k = k
        self.name = f"CP-DP, {k} interval{'s' if k > 1 else ''}"

    def of_bins(self, proba: RealArray, widths: FloatArray) -> RealArray:
        """Scores of all bins."""
        scores = np.empty(proba.shape)
        for start in range(0, len(proba), _ROWS):
            part = np.asarray(proba[start : start + _ROWS], dtype=np.float64)
            masks = shortest_unions(part, widths, self.k)
            scores[start : start + _ROWS] = [nested(p, p / widths, mask) for p, mask in zip(part, masks, strict=True)]
        return scores


def shortest_unions(proba: FloatArray, widths: FloatArray, k: int) -> BoolArray:
    """Bins (n, K) of the shortest unions of at most k intervals that have probability 1 - alpha."""
    n, n_bins = proba.shape
    masses = np.diff(np.rint(np.cumsum(proba, axis=1) * MASSES).astype(int), axis=1, prepend=0)
    units = np.arange(MASSES + 1)
    outside = np.full((n, k + 1, MASSES + 1), np.inf, dtype=np.float32)
    inside = outside.copy()
    outside[:, :, 0] = 0
    began, left = np.zeros((2, n_bins, n, k + 1, MASSES + 1), dtype=bool)
    for b in range(n_bins):
        before = np.maximum(units - masses[:, [b]], 0)[:, None]
        going_on = np.take_along_axis(inside, np.broadcast_to(before, inside.shape), 2)
        starting = np.take_along_axis(outside, np.broadcast_to(before, inside.shape), 2)
        starting = np.concatenate((np.full((n, 1, MASSES + 1), np.inf, np.float32), starting[:, :-1]), axis=1)
        left[b] = inside < outside
        outside = np.minimum(outside, inside)
        began[b] = starting < going_on
        inside = np.float32(widths[b]) + np.minimum(going_on, starting)
    rows, at = np.arange(n), np.full(n, round((1 - ALPHA) * MASSES))
    used, within = np.full(n, k), inside[rows, k, at] < outside[rows, k, at]
    mask = np.zeros((n, n_bins), dtype=bool)
    for b in range(n_bins)[::-1]:
        mask[:, b] = within
        first, stopped = began[b][rows, used, at], left[b][rows, used, at]
        at = np.where(within, np.maximum(at - masses[:, b], 0), at)
        used = used - (within & first)
        within = np.where(within, ~first, stopped)
    return mask


def nested(proba: FloatArray, density: FloatArray, mask: BoolArray) -> FloatArray:
    """Probability (K,) of the smallest of the nested unions around `mask` that holds each bin."""
    scores, total = np.empty(proba.size), float(proba[mask].sum())
    for grows, start in ((True, mask), (False, ~mask)):  # a set shrinks as its complement grows
        reached, mass = start.copy(), total
        ends = [b for b in range(proba.size) if not start[b] and start[max(b - 1, 0) : b + 2].any()]
        heap = [(-density[b] if grows else density[b], b) for b in ends] or [(0.0, int(density.argmax()))]
        heapq.heapify(heap)
        while heap:
            _, b = heapq.heappop(heap)
            if reached[b] or start[b]:
                continue
            reached[b] = True
            mass += proba[b] if grows else 0
            scores[b] = mass
            mass -= 0 if grows else proba[b]
            for c in (b - 1, b + 1):
                if 0 <= c < proba.size and not reached[c]:
                    heapq.heappush(heap, (-density[c] if grows else density[c], c))
    return scores


def pooled(groups: IntArray, weight: FloatArray, rows: IntArray) -> FloatArray:
    """Weights of the groups, the rows' own kernels included."""
    return np.tile(np.bincount(groups, weight) / weight.sum(), (rows.size, 1))


def hardest(X: dict[str, FloatArray], y: FloatArray, seed: int) -> BoolArray:
    """The quarter of the test rows whose residuals forests expect to be largest, as in peers.md."""
    options: dict[str, Any] = {"random_state": seed, "max_features": 0.5}
    location = RandomForestRegressor(200, oob_score=True, **options).fit(X["train"], y)
    spread = RandomForestRegressor(200, min_samples_leaf=10, **options)
    expected = spread.fit(X["train"], np.abs(y - location.oob_prediction_)).predict(X["test"])
    return np.asarray(expected >= np.quantile(expected, 0.75))


def measured(name: str, seed: int) -> dict[str, dict[str, Any]]:
    """Size in standard deviations, coverage and that of the hardest quarter, by score; seconds of a fit."""
    X_all, y_all = data(name, seed)
    order = np.random.default_rng(seed).permutation(len(y_all))
    n, n_cal = min(TRAIN, len(y_all) // 2), min(CAL, len(y_all) // 5)
    parts = dict(zip(("train", "cal", "test"), np.split(order[: n + n_cal + TEST], [n, n + n_cal]), strict=True))
    X, y = ({part: of[rows] for part, rows in parts.items()} for of in (X_all, y_all))
    hard, numbers = hardest(X, y["train"], seed), {}
    for fit in (OWN, CHOSEN):
        make = pooled if fit == OWN else mixture._without_own
        with patch.object(mixture, "_without_own", make):
            start = time.process_time()
            reg = ConformalRegressor(calibration_size=0, random_state=seed).fit(X["train"], y["train"])
            seconds = time.process_time() - start
        proba = {part: reg.predict_bins(X[part]) for part in ("cal", "test")}
        scores: dict[str, Any] = {OWN: "density"}
        if fit == CHOSEN:
            scores = {DENSITY: "density", CHOSEN: reg.calibrator_.score, "interval": "interval", "hpd": "hpd"}
            scores |= {(optimal := VolumeOptimal(2)).name: optimal}
        for kind, score in scores.items():
            bins: QuantileBins = reg.bins_
            regions = SplitConformal(bins, ALPHA, score).calibrate(proba["cal"], y["cal"]).predict(proba["test"])
            held = regions.contains(y["test"])[:, 0]
            numbers[kind] = {
                "size": float(regions.length.mean() / y["train"].std()),
                "coverage": float(held.mean()),
                "hardest": float(held[hard].mean()),
                "seconds": seconds,
                "score": reg.calibrator_.score_.name if kind == CHOSEN else kind,
            }
    return numbers


def main() -> None:
    seeds = parser_with_seeds(__doc__, SEEDS).parse_args().seeds
    runs: dict[str, list[dict[str, dict[str, Any]]]] = {}
    for name in TABLES:
        files = [RUNS / "table_scores" / f"{name}-{seed}.json" for seed in seeds]
        runs[name] = [cached_json(file, partial(measured, name, seed)) for file, seed in zip(files, seeds, strict=True)]
        print(
            name, {k: round(float(np.mean([r[k]["size"] for r in runs[name]])), 3) for k in runs[name][0]}, flush=True
        )
    kinds = list(runs[TABLES[0]][0])
    sizes, hard, rows = [], [], []
    ratios = {kind: [] for kind in kinds}
    for name, of in runs.items():
        for kind in kinds:
            logs = [np.log(run[kind]["size"] / run[OWN]["size"]) for run in of]
            ratios[kind].append(float(np.exp(np.mean(logs))))
        sizes.append([name, f"{np.mean([run[OWN]['size'] for run in of]):.3f}"])
        sizes[-1] += [f"{ratios[kind][-1]:.3f}" for kind in kinds[1:]]
        covered = {kind: [np.mean([run[kind][of_] for run in of]) for of_ in ("hardest", "coverage")] for kind in kinds}
        hard.append([name, *(f"{covered[kind][0]:.3f} ({covered[kind][1]:.3f})" for kind in kinds)])
        chosen = [run[CHOSEN]["score"] for run in of]
        shares = ", ".join(f"{one} {chosen.count(one)}" for one in sorted(set(chosen)))
        seconds = [np.mean([run[kind]["seconds"] for run in of]) for kind in (OWN, CHOSEN)]
        rows.append([name, shares, *(f"{each:.1f}" for each in seconds)])
    sizes.append(["geometric mean", "", *(f"{np.exp(np.mean(np.log(ratios[kind]))):.3f}" for kind in kinds[1:])])
    least = [min(np.mean([run[kind]["hardest"] for run in of]) for of in runs.values()) for kind in kinds]
    hard.append(["least", *(f"{each:.3f}" for each in least)])
    notes = (
        f"alpha = {ALPHA}; {TRAIN} rows to learn from (half of smaller tables), at most {CAL} to calibrate and {TEST} "
        f"new ones, drawn at random with seeds {seeds[0]} to {seeds[-1]}; settings were chosen on others. All are "
        f"scores of the same densities, but for the column `{OWN}`, in which rows lend kernels to themselves when "
        "bandwidths are chosen. CP-DP (arXiv 2502.16658): nested unions of intervals around the shortest, by dynamic "
        "programming."
    )
    write_page(
        "table_scores",
        "Scores for tables",
        "python benchmarks/table_scores.py",
        notes,
        "## Size",
        f"Mean length, in standard deviations of the training values with `{OWN}`, then over that: shorter is better.",
        table_lines(["table", *kinds], sizes),
        "## Coverage of the hardest quarter, in brackets of all",
        "Of the test rows, by residuals that forests expect, the same rows for all. Guaranteed is 0.9 for all rows.",
        table_lines(["table", *kinds], hard),
        "## Scores that `auto` chose, of how many seeds, and seconds of a fit",
        table_lines(["table", "chosen", f"seconds, {OWN}", "seconds"], rows),
    )


if __name__ == "__main__":
    main()
