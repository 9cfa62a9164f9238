"""Whether regions are bounded, and the band of their coverage: the calibration itself and its law are asked."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import betabinom

from conformodal.conformal import QuantileBins, SplitConformal, conformal_rank
from conformodal.io import SplitKind
from conformodal.localizer.regions import EvidenceType, RegionRules
from conformodal.pipeline.guarantee import N_NEW, describe_guarantee, guarantees
from conformodal.pipeline.model import SourceComparison

BINS = QuantileBins.from_edges([[0, 1, 2], [0, 1, 2]])


def model(n=60, n_recognised=20, *, infinite=0, exchangeable=True, groups=None):
    """A model calibrated on n frames, of which some are recognised and some lie beyond the training range."""
    rule = SplitConformal(BINS, 0.1, "density", "max")
    rule.set_scale()
    scores = np.random.default_rng(n).random((n, 2))
    scores[:infinite, 1] = np.inf
    rule = rule.calibrate_scores(scores, groups, None)
    rules = RegionRules(rule, np.arange(n) < n_recognised, np.ones(n), 0.0)
    return SimpleNamespace(rules=rules, frames_are_exchangeable=exchangeable)


def test_each_evidence_type_has_a_guarantee_by_the_exact_law():
    listed = {one.evidence: one for one in guarantees(model())}
    assert {kind: one.n_frames for kind, one in listed.items()} == {
        EvidenceType.UNMATCHED: 40,
        EvidenceType.LANDMARKS: 20,
    }
    for one in listed.values():
        k = conformal_rank(one.n_units, 0.1)
        law = betabinom(N_NEW, k, one.n_units + 1 - k)
        assert one.finite
        assert one.band == pytest.approx((law.ppf(0.005) / N_NEW, law.ppf(0.995) / N_NEW))
        assert f"{one.band[0]:.3f} to {one.band[1]:.3f}" in one.describe()


@pytest.mark.parametrize(("exchangeable", "groups"), [(False, None), (True, np.repeat(np.arange(12), 5))])
def test_no_band_is_stated_where_no_law_is_exact(exchangeable, groups):
    for one in guarantees(model(exchangeable=exchangeable, groups=groups)):
        assert one.band is None
        assert "band" not in one.describe()


def test_regions_are_bounded_from_the_needed_weight_on():
    """With one evidence type of frames, the weight is the number of frames."""
    for n in (8, 9):
        whole = model(n, 0)
        whole.rules = RegionRules(whole.rules.overall, None, np.ones(n), 0.0)
        (one,) = guarantees(whole)
        assert one.weight_needed == pytest.approx(9)
        assert one.finite == (one.weight >= 9)


STRETCHES = np.repeat(np.arange(12), 5)


@pytest.mark.parametrize(
    ("split", "groups", "n_folds_only", "stated", "not_stated"),
    [
        ("interleaved", None, None, ["drawn at random together"], ["test frames"]),
        ("blocks", None, None, ["such as the test frames, are not"], ["drawn at random"]),
        ("blocks", STRETCHES, 0, ["a new stretch", "the 12 that"], ["test frames", "does not hold"]),
        ("given", STRETCHES, 0, ["does not reach the test frames"], ["does not hold"]),
        ("recordings", STRETCHES, 40, ["0.580 of the poses", "does not hold"], ["test frames"]),
    ],
)
def test_the_guarantee_is_stated_with_its_condition(split, groups, n_folds_only, stated, not_stated):
    whole = model(groups=groups)
    whole.calibration, whole.alpha, whole.n_calibration, whole.configuration = whole.rules.overall, 0.1, 60, {}
    whole.split, whole.frames_are_exchangeable = SimpleNamespace(kind=SplitKind(split)), split == "interleaved"
    whole.comparison, whole.journal, whole.journal_with_poses = None, (), []
    if n_folds_only is not None:
        whole.comparison = SourceComparison(100, 58, 0, n_folds_only, 0.5)
    text = describe_guarantee(whole)
    assert "the whole pose with probability at least 0.9" in text
    assert [words in text for words in (*stated, *not_stated)] == [True] * len(stated) + [False] * len(not_stated)
