from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from conformodal.conformal import QuantileBins, SplitConformal, conformal_quantile
from conformodal.localizer.regions import EvidenceType, RegionRules

GLOBAL, UNMATCHED, LANDMARKS, UNKNOWN, DISTURBED, WEAK = EvidenceType


def calibrated(bins, n=80, joint="max", seed=0, groups=None):
    scores = np.random.default_rng(seed).random((n, bins.n_targets))
    return SplitConformal(bins, 0.2, "hpd", joint).calibrate_scores(scores, groups)


@pytest.fixture
def bins():
    return QuantileBins.from_edges([np.arange(6.0)] * 7)


@pytest.fixture
def rules(bins):
    rng = np.random.default_rng(1)
    matched, known_p = rng.random(80) < 0.6, rng.integers(1, 20, 80) / 20
    return RegionRules(calibrated(bins, seed=5), matched, known_p, 0.05)


def test_kinds_follow_the_p_values_and_what_was_recognised(rules):
    known_p = np.array([1.0, 0.06, 0.05, 0.5, 0.04, 0.02, 0.01])
    recognised = np.array([False, False, False, True, True, True, False])
    expected = [UNMATCHED, UNMATCHED, UNKNOWN, LANDMARKS, WEAK, WEAK, UNKNOWN]
    assert rules.kinds(known_p, recognised).tolist() == expected
    by_level = [GLOBAL, GLOBAL, UNKNOWN, GLOBAL, UNKNOWN, UNKNOWN, UNKNOWN]
    alone = RegionRules(rules.overall, None, rules.known_p, rules.level)
    assert alone.kinds(known_p, recognised).tolist() == by_level
    assert list(alone.by_type) == [GLOBAL]
    assert alone.thresholds(np.array([LANDMARKS])).tolist() == [[np.inf] * 7]  # nothing was calibrated for it


@pytest.mark.parametrize("alpha", [0.2, 0.4])
def test_every_kind_has_the_conformal_quantile_of_its_own_frames(rules, alpha):
    known_p = np.where(np.arange(80) % 10 == 0, 0.0, rules.known_p)  # of images from beyond the range of poses
    rules, known = replace(rules.at(alpha), known_p=known_p), known_p > 0.05
    of = {UNMATCHED: known & ~rules.recognised, LANDMARKS: (known_p > 0) & rules.recognised}
    np.testing.assert_array_equal(rules.known, of[UNMATCHED] | of[LANDMARKS])
    for kind, chosen in of.items():
        expected = conformal_quantile(rules.overall.scores_[chosen].max(axis=1), alpha)
        np.testing.assert_allclose(rules.thresholds(np.array([kind]))[0], np.full(7, expected), rtol=1e-11)
        assert rules.by_type[kind].n_units == chosen.sum()
    assert (rules.thresholds(np.array([UNKNOWN])) == np.inf).all()
    assert rules.overall.alpha == alpha
    alone = replace(rules, recognised=None)
    expected = conformal_quantile(rules.overall.scores_[known].max(axis=1), alpha)
    np.testing.assert_allclose(alone.thresholds(np.array([GLOBAL]))[0], np.full(7, expected), rtol=1e-11)


def test_disturbed_images_use_their_own_quantile(rules):
    """That of disturbed frames of known places."""
    copies, p = calibrated(rules.overall.bins, 40, seed=9), np.arange(40) / 40
    rules = replace(rules, disturbed=copies, disturbed_p=p).at(0.4)
    recognised, disturbed = np.arange(6) < 4, np.array([1, 0, 0, 1, 1, 1], dtype=bool)
    kinds = rules.kinds(np.array([1.0, 1.0, 0.05, 0.05, 0.06, 0.05]), recognised, disturbed)
    assert kinds.tolist() == [DISTURBED, LANDMARKS, WEAK, DISTURBED, DISTURBED, UNKNOWN]
    own = conformal_quantile(copies.scores_[p > 0.05].max(axis=1), 0.4)
    np.testing.assert_allclose(rules.by_type[DISTURBED].thresholds_, np.full(7, own), rtol=1e-11)
    others = [rules.by_type[other].thresholds_ for other in (LANDMARKS, UNMATCHED)]
    np.testing.assert_allclose(rules.thresholds(kinds[:1])[0], np.maximum(own, np.max(others, axis=0)), rtol=1e-11)
    landmarks = rules.by_type[LANDMARKS].thresholds_
    np.testing.assert_allclose(rules.thresholds(kinds[2:3])[0], np.maximum(own, landmarks), rtol=1e-11)
    alone = replace(rules, disturbed=None, disturbed_p=None)
    np.testing.assert_array_equal(alone.thresholds(kinds[2:3])[0], landmarks)
    unmatched = replace(rules, recognised=np.zeros(80, dtype=bool))  # nothing calibrates LANDMARKS
    assert (unmatched.thresholds(kinds[2:3]) == np.inf).all()
    expected = np.maximum(own, unmatched.by_type[UNMATCHED].thresholds_)
    np.testing.assert_allclose(unmatched.thresholds(kinds[:1])[0], expected, rtol=1e-11)


@pytest.mark.parametrize(("n_matched", "bounded"), [(0, False), (8, False), (9, True)])
def test_evidence_type_of_few_frames_is_unbounded(bins, n_matched, bounded):
    """The other type keeps its thresholds."""
    whole = calibrated(bins)
    rules = RegionRules(whole, np.arange(80) < n_matched, np.ones(80), 0.01).at(0.1)
    unmatched, landmarks = rules.thresholds(np.array([UNMATCHED, LANDMARKS]))
    assert np.isfinite(landmarks).all() == bounded
    np.testing.assert_allclose(unmatched, conformal_quantile(whole.scores_[n_matched:].max(axis=1), 0.1), rtol=1e-11)


def drawn(rng, n_units, n_members):
    """Types (n, m) and scores (n, m, 2) of units that are of one type mostly, which one differs."""
    recognised = rng.random((n_units, n_members)) < rng.choice([0.05, 0.95], (n_units, 1), p=[0.4, 0.6])
    unlike = np.where(recognised, 0.0, rng.choice([0.0, 2.0]))
    return recognised, rng.random((n_units, n_members, 2)) + rng.random((n_units, 1, 1)) + unlike[..., None]


@pytest.mark.parametrize(("joint", "alpha"), [("none", 0.25), ("bonferroni", 0.5), ("max", 0.25)])
@pytest.mark.parametrize("n_members", [1, 3])
def test_the_guarantee_holds_in_each_type(joint, alpha, n_members):
    """Each of the units is the new one once: of exchangeable units, this average is their law, without noise.

    That of `LANDMARKS` holds for all frames in which a place is recognised, the weak ones included.
    """
    rng = np.random.default_rng(n_members)
    cells = QuantileBins.from_edges([np.arange(3.0)] * 2)
    for _ in range(25):
        n_units = int(rng.integers(8, 13))
        recognised, scores = drawn(rng, n_units, n_members)
        missed = np.empty(scores.shape, dtype=bool)
        for new in range(n_units):
            others = np.delete(np.arange(n_units), new)
            groups = None if n_members == 1 else np.repeat(others, n_members)
            whole = SplitConformal(cells, alpha, "hpd", joint).calibrate_scores(scores[others].reshape(-1, 2), groups)
            rules = RegionRules(whole, recognised[others].ravel(), np.ones(len(whole.scores_)), 0.5)
            if new % 2:
                rules = replace(rules, disturbed=copy(whole), disturbed_p=rng.random(len(whole.scores_)))
            known_p = np.where(recognised[new], 1 - scores[new].max(axis=1) / 2, 1.0)  # the worse, the more weakly
            missed[new] = scores[new] > rules.thresholds(rules.kinds(known_p, recognised[new]))
        events = missed.any(axis=2, keepdims=True) if joint != "none" else missed
        for chosen in (recognised, ~recognised):
            if chosen.any():
                assert (events[chosen].mean(axis=0) <= alpha + 1e-12).all()
