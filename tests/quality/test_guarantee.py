"""The least alpha is where thresholds begin to be finite: the calibration itself is asked, there and just below."""

from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import betabinom

from conformodal.conformal import QuantileBins, SplitConformal, conformal_rank
from conformodal.io import SplitKind
from conformodal.localizer.region_rules import EvidenceType, RegionRules
from conformodal.quality.advice import _more_units, describe_guarantee
from conformodal.quality.guarantee import N_NEW, guarantees, least_alpha

BINS = QuantileBins.from_edges([[0, 1, 2], [0, 1, 2]])
A_BIT = Fraction(1, 10**9)


def rule(n, *, infinite=0, joint="none", groups=None, sizes=None, alpha=0.1):
    made = SplitConformal(BINS, alpha, "density", joint)
    made.rule.keep_scale()
    scores = np.random.default_rng(n).random((n, 2))
    scores[:infinite, 1] = np.inf
    return made.calibrate_scores(scores, groups, sizes)


RULES = {
    "frames": rule(37),
    "frames beyond the range": rule(37, infinite=3),
    "one threshold for all": rule(37, infinite=3, joint="max"),
    "alpha shared out": rule(37, joint="bonferroni"),
    "stretches": rule(40, groups=np.repeat(np.arange(8), 5)),
    "stretches of unlike length": rule(40, infinite=7, groups=np.repeat([0, 1, 2, 3], [2, 7, 11, 20])),
    "a part of each stretch": rule(
        12, groups=np.repeat([0, 1, 2], [2, 4, 6]), sizes=np.repeat([9, 5, 6], [2, 4, 6]), infinite=1
    ),
}


@pytest.mark.parametrize("what", RULES)
def test_from_the_least_alpha_on_thresholds_are_finite(what):
    made = RULES[what]
    least = least_alpha(made)
    assert 0 < least < 1
    assert np.isfinite(made.at(least).thresholds_).all()
    assert np.isinf(made.at(least - A_BIT).thresholds_).any()


def model(split, **how):
    made = rule(60, joint="max", **how)
    recognised = np.arange(60) < 20
    rules = RegionRules(made, recognised, np.ones(60), 0.0)
    return SimpleNamespace(rules=rules, frames_are_exchangeable=split is SplitKind.INTERLEAVED)


def test_each_evidence_type_has_a_guarantee_of_its_own():
    found = {one.evidence: one for one in guarantees(model(SplitKind.INTERLEAVED))}
    assert {kind: one.n_frames for kind, one in found.items()} == {
        EvidenceType.UNMATCHED: 40,
        EvidenceType.LANDMARKS: 20,
    }
    for one in found.values():
        n = one.n_units
        assert conformal_rank(one.n_needed, 0.1) <= one.n_needed
        assert conformal_rank(one.n_needed - 1, 0.1) > one.n_needed - 1
        # the share of new frames that is covered follows this law
        k = conformal_rank(n, 0.1)
        law = betabinom(N_NEW, k, n + 1 - k)
        assert one.band == pytest.approx((law.ppf(0.005) / N_NEW, law.ppf(0.995) / N_NEW))
    said = describe_guarantee(found[EvidenceType.LANDMARKS])
    assert "calibrated on 20 frames, bounded from alpha = 0.0477" in said  # 1 / 21, rounded up
    assert "at alpha = 0.1 (99 % band)" in said


@pytest.mark.parametrize(
    ("split", "groups"), [(SplitKind.BLOCKS, None), (SplitKind.INTERLEAVED, np.repeat(np.arange(12), 5))]
)
def test_no_band_is_stated_where_no_law_is_exact(split, groups):
    for one in guarantees(model(split, groups=groups)):
        assert one.band is None
        assert "band" not in describe_guarantee(one)


TYPES = {
    "frames": (60, 20, None),
    "few of one type": (60, 4, None),
    "frames beyond the range": (60, 20, 5),
    "stretches of both types": (48, 20, None),
}


@pytest.mark.parametrize("joint", ["none", "bonferroni", "max"])
@pytest.mark.parametrize("case", TYPES)
def test_regions_are_bounded_from_the_least_alpha_on(case, joint):
    n, n_recognised, infinite = TYPES[case]
    groups = np.arange(n) % 16 if case.startswith("stretches") else None
    whole = rule(n, infinite=infinite or 0, joint=joint, groups=groups)
    rules = RegionRules(whole, np.arange(n) < n_recognised, np.ones(n), 0.0)
    for one in guarantees(SimpleNamespace(rules=rules, frames_are_exchangeable=False)):
        kind, least = np.array([one.evidence]), one.least_alpha
        larger = [least, *(least + (1 - least) * Fraction(k, 10) for k in range(1, 10))]
        for alpha in larger:
            assert np.isfinite(exactly(rules, alpha).thresholds(kind)).all()
        assert np.isinf(exactly(rules, least - A_BIT).thresholds(kind)).any()


def exactly(rules, alpha):
    return RegionRules(rules.overall.at(alpha), rules.recognised, rules.known_p, rules.level)


def stretches(n_units, joint="max"):
    """Regions that are calibrated on stretches in which one of four frames is recognised, and one is unknown."""
    whole = rule(4 * n_units, joint=joint, groups=np.repeat(np.arange(n_units), 4))
    known_p = np.tile([1.0, 1.0, 1.0, 0.0], n_units)
    rules = RegionRules(whole, np.tile([True, False, False, False], n_units), known_p, 0.0)
    return SimpleNamespace(rules=rules, frames_are_exchangeable=False)


@pytest.mark.parametrize("joint", ["max", "bonferroni"])
def test_as_many_stretches_as_are_said_to_be_needed_give_bounded_regions(joint):
    """Nine stretches are too few where a quarter of their frames is unknown: those that count weigh less than nine."""
    for one in guarantees(stretches(9, joint)):
        assert not one.finite
        assert one.n_needed > 9
        assert f"takes {one.n_needed} stretches" in _more_units(one)
        after = {new.evidence: new.finite for new in guarantees(stretches(one.n_needed, joint))}
        before = {new.evidence: new.finite for new in guarantees(stretches(one.n_needed - 1, joint))}
        assert after[one.evidence]
        assert not before[one.evidence]


def test_more_of_the_same_is_not_advised_where_too_many_frames_lie_beyond_the_range():
    made = rule(60, infinite=7, joint="max")
    rules = RegionRules(made, None, np.ones(60), 0.0)
    (one,) = guarantees(SimpleNamespace(rules=rules, frames_are_exchangeable=True))
    assert not one.finite
    assert one.n_needed is None
    assert "beyond the training range" in _more_units(one)


def test_nothing_to_calibrate_on_allows_no_alpha():
    assert least_alpha(rule(0)) == 1
    assert least_alpha(rule(4, infinite=4)) == 1
