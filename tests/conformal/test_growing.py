"""Calibration by recordings that came one after another, each scored before it joined the map."""

import numpy as np
import pytest
from scipy.stats import binom

from conformodal.conformal import conformal_quantile, conformal_rank, hierarchical_quantile

ALPHA = 0.1


def recordings(n, n_frames, rng):
    """Scores of frames (n, m): those of one recording are alike."""
    return rng.gamma(2, size=(n, 1)) * rng.exponential(size=(n, n_frames))


@pytest.mark.parametrize("n", [9, 19, 29])
def test_fixed_map_coverage_follows_the_exact_law(n):
    """Of one frame of the next recording."""
    rng, n_orders = np.random.default_rng(20), 5000
    scores = np.stack([recordings(n + 1, 1, rng)[:, 0] for _ in range(n_orders)])
    held = int((scores[:, n] <= conformal_quantile(scores[:, :n], ALPHA, axis=1)).sum())
    low, high = binom.interval(0.999, n_orders, conformal_rank(n, ALPHA) / (n + 1))
    assert low <= held <= high


@pytest.mark.parametrize("growth", [0.0, 1.0])
def test_growing_map_coverage_is_at_least_nominal(growth):
    """30 recordings, 1000 orders; scores shrink as the map grows, or stay."""
    rng, held = np.random.default_rng(21), []
    shrinking = (1 + np.arange(30)) ** (-growth / 2)
    for _ in range(1000):
        scores = recordings(30, 12, rng) * shrinking[:, None]
        held.append((scores[29] <= hierarchical_quantile(scores[:29], ALPHA)).mean())
    assert np.mean(held) >= 1 - ALPHA - 0.01
    if growth:  # conservative, since more map helps
        assert np.mean(held) > 1 - ALPHA + 0.03
