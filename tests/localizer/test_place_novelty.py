from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from conformodal.conformal import NoveltyTest
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.io import THUMBNAIL
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.regions import EvidenceType, PlaceNovelty
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.store import load_model, save_model

SOMETHING_ELSE = {
    "noise": np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8),
    "black": np.zeros((120, 160, 3), np.uint8),
}


@pytest.fixture(scope="module")
def model(small_world):
    return load_model(small_world.model)


@pytest.fixture(scope="module")
def features(sequence, model, small_world):
    paths = [sequence.image_paths[i] for i in model.split.test]
    return extract_features(paths, model.backbone, FeatureCache(small_world.cache))


def kinds_of(model, p):
    """Of images in which no place is recognised."""
    return model.rules.kinds(p, np.zeros(len(p), dtype=bool))


def test_test_frames_are_known(model, features):
    """They were held out at random, as every reference frame is from itself: P(p <= u) <= u."""
    p = model.novelty.p_values(FrameEvidence(features))
    assert ((p > 0) & (p <= 1)).all()
    assert p.max() > 0.9
    assert len(np.unique(p)) > 0.5 * len(p)
    for u in (0.05, 0.1, 0.2, 0.5):
        assert (p <= u).sum() <= stats.binom.ppf(0.999, len(p), u)
    assert (kinds_of(model, p) == EvidenceType.UNKNOWN).mean() < 0.05
    assert model.rules.level == pytest.approx(max(0.015, 1 / (model.n_calibration + 1)))
    np.testing.assert_array_equal(model.novelty.test.units_, model.split.train)  # every training frame by itself


def test_the_default_level_is_that_of_frames_or_of_stretches():
    references, rows = np.random.default_rng(0).normal(size=(200, 3)), np.arange(200)

    def level(units, asked=None):
        return PlaceNovelty(NoveltyTest(references[: len(units)], units), (1, 1)).level(asked)

    assert level(rows) == 0.015
    assert level(rows // 4) == 0.1
    assert level(rows[:20]) == pytest.approx(1 / 21)  # no p-value is smaller
    assert level(rows, 0.3) == 0.3


@pytest.mark.parametrize("what", SOMETHING_ELSE)
def test_a_stream_says_that_it_does_not_know_a_place_and_goes_on(model, sequence, what):
    odometry = VisualOdometry(model)
    first = odometry.step(sequence.image(50), 1.0)
    assert first.evidence is not EvidenceType.UNKNOWN
    lost = odometry.step(SOMETHING_ELSE[what], 1.1)
    assert lost.evidence is EvidenceType.UNKNOWN
    assert lost.region.unbounded.all()
    assert not lost.reliable
    assert "like no place that is known" in lost.problem
    assert lost.known_p == pytest.approx(model.novelty.matched.least_p)
    # the pose is where the camera can have come to, as far as it knows, and less sure
    reach = model.prior.reach_m(0.1)
    away = np.linalg.norm(lost.pose.position_xyz - first.pose.position_xyz)
    assert away <= reach + lost.position_spread_m
    assert away < 0.5
    assert lost.position_spread_m > first.position_spread_m
    assert lost.orientation_spread_rad > first.orientation_spread_rad
    again = odometry.step(sequence.image(51), 1.2)
    assert again.evidence is not EvidenceType.UNKNOWN
    assert not again.region.unbounded.all()


def test_the_level_can_be_set_and_is_kept(model, features, tmp_path):
    p, strict, level = model.novelty.p_values(FrameEvidence(features)), replace(model), model.rules.level
    strict.set_novelty_level(0.2)
    np.testing.assert_array_equal(kinds_of(strict, p) == EvidenceType.UNKNOWN, p <= 0.2)
    known = model.rules.known_p > np.where(model.rules.recognised, 0.0, 0.2)
    assert (
        sum(rule.n_units for kind, rule in strict.rules.by_type.items() if kind != EvidenceType.DISTURBED)
        == known.sum()
    )
    save_model(strict, tmp_path)
    assert load_model(tmp_path).rules.level == 0.2
    strict.set_novelty_level(0.0)
    assert (kinds_of(strict, p) != EvidenceType.UNKNOWN).all()
    assert model.rules.level == level
    for wrong in (-0.1, 1.0, np.nan):
        with pytest.raises(OdometryError, match="novelty_level"):
            strict.set_novelty_level(wrong)


GRID = (6, 8)


def made_features(rng, n, grid=GRID, channels=4):
    """Features of n pictures that are not like each other, rounded as a backbone rounds them."""
    made = rng.normal(size=(n, channels * grid[0] * grid[1] + THUMBNAIL[0] * THUMBNAIL[1]))
    return made.astype(np.float16).astype(np.float32)


@pytest.mark.parametrize("n", [99, 700])
def test_a_camera_that_stands_still_sees_what_is_known(n):
    picture = made_features(np.random.default_rng(0), 1)
    known = PlaceNovelty.fit(np.repeat(picture, n, axis=0), np.arange(n), GRID)
    assert known.p_values(FrameEvidence(picture)) == 1
    np.testing.assert_array_equal(known.p_values(FrameEvidence(np.repeat(picture, 300, axis=0))), 1)
