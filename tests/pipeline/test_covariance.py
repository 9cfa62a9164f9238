"""The covariance of poses, calibrated on held-out streams."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from conformodal.conformal import QuantileBins, hierarchical_quantile
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import MotionPrior, Posterior
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.calibrate_paths import squared_error
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.model import ONLINE, PathRule, path_rule
from conformodal.pipeline.store import load_model, save_model
from tests.small_model import image, small_model

CELLS = QuantileBins.from_edges([np.linspace(-1, 1, 11)] * 7)
PRIOR = MotionPrior(0.5, (0.1, 0.2), (1.0, 0.9), (0.2, 0.1), 2.0, 0.3, 20.0)


def one_room(squared):
    return np.zeros(len(squared), int)


def rule_of(squared, units=None, alpha=0.1):
    calibration = path_rule(CELLS, alpha).calibrate_scores(np.zeros((len(squared), 7)), units)
    return PathRule(calibration, 0.2, np.asarray(squared, float), np.ones(len(squared)), 0.1, one_room(squared))


def factor(rule):
    return rule.variance_factors(np.array([False]), np.array([0]))[0]


def test_the_ellipsoid_holds_a_new_pose_as_often_as_asked():
    """Its law is that of a conformal quantile: errors over the covariance may have any distribution."""
    rng, held = np.random.default_rng(0), []
    for _ in range(400):
        squared = 40 * rng.pareto(1.2, 60)  # no chi-squared law, and too sure by far
        limit = factor(rule_of(squared[:-1])) * chi2.ppf(0.9, 6)
        held.append(squared[-1] <= limit * (1 + 1e-9))
    expected = 54 / 60  # of 59 errors, the 54th smallest is the limit
    assert abs(np.mean(held) - expected) < 4 * np.sqrt(expected * (1 - expected) / 400)


def test_the_variance_factor_weighs_stretches_equally():
    """Where stretches are too few, the factor is that of the largest error."""
    rng = np.random.default_rng(1)
    units, squared = np.repeat(np.arange(12), [1, 30, *[5] * 10]), rng.chisquare(6, 81)
    limit = hierarchical_quantile([squared[units == k] for k in range(12)], 0.2)
    assert factor(rule_of(squared, units, 0.2)) == pytest.approx(limit / chi2.ppf(0.8, 6))
    few = rule_of(squared[:31], units[:31], 0.2)
    assert factor(few) == pytest.approx(squared[:31].max() / chi2.ppf(0.8, 6))
    assert factor(rule_of(np.full(3, 0.1), np.zeros(3, int), 0.2)) == 1  # nothing says that it is smaller
    assert factor(rule_of(np.empty(0), np.empty(0, int))) == 1


def test_errors_of_a_normal_belief_follow_the_chi_squared_law():
    rng, squared = np.random.default_rng(2), []
    pose = np.array([[1.0, 2.0, 0.5]]), np.array([[0.1, 0.02, 0.3]])
    quat = Rotation.from_rotvec([0.3, -0.2, 1.0])
    belief = PoseMixture.weighted(*pose, quat.as_quat(scalar_first=True)[None], np.array([0.05]), np.zeros(1))
    posterior = Posterior(belief, 1e-9)
    for _ in range(3000):
        turned = Rotation.from_rotvec(rng.normal(0, 0.05, 3)) * quat
        target = np.concatenate((rng.normal(*pose)[0], -turned.as_quat(scalar_first=True)))
        squared.append(squared_error(posterior, belief, target, PRIOR))
    for share in (0.5, 0.9):
        assert np.mean(squared <= chi2.ppf(share, 6)) == pytest.approx(share, abs=4 * np.sqrt(0.25 / 3000))


def test_estimates_state_the_calibrated_covariance():
    model = small_model()
    sure, unsure = (
        replace(model, path_rules={**model.path_rules, ONLINE: replace(model.path_rules[ONLINE], squared=squared)})
        for squared in (np.full(60, 1.0), np.full(60, 9.0))
    )
    ours, other = (VisualOdometry(one).step(image(), 1.0) for one in (sure, unsure))
    np.testing.assert_allclose(other.covariance, 9 * ours.covariance)
    assert other.position_spread_m == ours.position_spread_m  # of one place, as believed
    alone = VisualOdometry(replace(model, path_rules={})).step(image(), 1.0)
    np.testing.assert_allclose(ours.covariance, factor(sure.path_rules[ONLINE]) * alone.covariance)
    unsure.recalibrate("1/4")
    again = VisualOdometry(unsure).step(image(), 1.0)
    np.testing.assert_allclose(again.covariance, 9 / chi2.ppf(0.75, 6) * alone.covariance)


def test_novel_frames_have_their_own_factor_and_thresholds():
    rng = np.random.default_rng(3)
    novel, room = np.repeat([False, True], 50), np.zeros(1, int)
    squared = np.concatenate((rng.chisquare(6, 50), 100 * rng.chisquare(6, 50)))
    scores = np.repeat(np.concatenate((rng.random(50), np.full(50, np.inf)))[:, None], 7, axis=1)
    p = np.where(novel, 0.05, 1.0)
    both = PathRule(path_rule(CELLS, 0.1).calibrate_scores(scores), 0.2, squared, p, 0.1, one_room(p))
    for kind, rows in ((False, slice(None, 50)), (True, slice(50, None))):
        calibration = path_rule(CELLS, 0.1).calibrate_scores(scores[rows])
        alone = PathRule(calibration, 0.2, squared[rows], p[rows], 0.1, one_room(p[rows]))
        asked = np.array([kind]), room
        np.testing.assert_array_equal(both.thresholds(*asked), alone.calibration.thresholds_[None])
        assert both.variance_factors(*asked) == pytest.approx(alone.variance_factors(*asked))
    assert np.isfinite(both.thresholds(np.array([False, True]), np.zeros(2, int))).all(axis=1).tolist() == [True, False]


def test_few_frames_of_a_kind_take_their_largest_error():
    squared, p = np.concatenate((np.full(6, 20.0), np.full(2, 1e8))), np.repeat([1.0, 0.05], [6, 2])
    few = PathRule(path_rule(CELLS, 0.1).calibrate_scores(np.zeros((8, 7))), 0.2, squared, p, 0.1, one_room(p))
    both = np.array([False, True]), np.zeros(2, int)
    assert few.variance_factors(*both) == pytest.approx(np.array([20, 1e8]) / chi2.ppf(0.9, 6))
    # of frames of all kinds where none is of their own
    assert replace(few, level=0.01).variance_factors(*both) == pytest.approx(1e8 / chi2.ppf(0.9, 6))


def test_the_p_value_of_a_new_image_chooses_its_factor():
    model = small_model()
    rule = model.path_rules[ONLINE]
    squared = np.where(rule.novel, 9.0, 1.0)
    model = replace(model, rooms=None, path_rules={ONLINE: replace(rule, squared=squared, rooms=one_room(squared))})
    answer = VisualOdometry(model).step(image(), 1.0)
    level = model.rules.level
    known, weak, unknown = EvidenceType.LANDMARKS, EvidenceType.WEAK, EvidenceType.UNKNOWN
    asked = (2 * level, known, 1.0), (np.nan, known, 1.0), (level, weak, 9.0), (0.9, unknown, 9.0)  # out of range
    for p, kind, error in asked:
        told = SimpleNamespace(known_p=np.array([p]), kinds=np.array([kind]))
        assert model.variance_factor(told, answer.posterior) == pytest.approx(error / chi2.ppf(0.8, 6))


def test_another_level_makes_other_frames_novel(tmp_path):
    model = small_model()
    assert model.path_rules[ONLINE].novel.tolist() == (model.path_rules[ONLINE].known_p == 0).tolist()
    model.set_novelty_level(0.5)
    save_model(model, tmp_path)
    for one in (model, load_model(tmp_path)):
        rule = one.path_rules[ONLINE]
        assert rule.level == one.rules.level == 0.5
        assert rule.novel.tolist() == (rule.known_p <= 0.5).tolist()
        assert set(rule.known_p[rule.novel]) == {0.0, 0.5}
