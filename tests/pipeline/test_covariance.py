"""The covariance of poses, calibrated on held-out streams."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from conformodal.conformal import QuantileBins, hierarchical_quantile
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import MotionPrior, Posterior
from conformodal.pipeline.calibrate_paths import squared_error
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.model import ONLINE, PathRule, path_groups, path_rule, renumber_rooms
from tests.small_model import image, small_model

CELLS = QuantileBins.from_edges([np.linspace(-1, 1, 11)] * 7)
PRIOR = MotionPrior(0.5, (0.1, 0.2), (1.0, 0.9), (0.2, 0.1), 2.0, 0.3, 20.0)


def rule_of(squared, units=None, alpha=0.1):
    calibration = path_rule(CELLS, alpha).calibrate_scores(np.zeros((len(squared), 7)), units)
    return PathRule(calibration, 0.2, np.asarray(squared, float), np.zeros(len(squared), int))


def factor(rule):
    return rule.variance_factors(np.array([0]))[0]


def test_the_ellipsoid_holds_a_new_pose_as_often_as_asked():
    """Its law is that of a conformal quantile: errors over the covariance may have any distribution."""
    rng, held = np.random.default_rng(0), []
    for _ in range(400):
        squared = 40 * rng.pareto(1.2, 60)  # no chi-squared law, and too sure by far
        limit = factor(rule_of(squared[:-1])) * chi2.ppf(0.9, 6)
        held.append(squared[-1] <= limit * (1 + 1e-9))
    expected = 54 / 60  # of 59 errors, the 54th smallest is the limit
    assert abs(np.mean(held) - expected) < 4 * np.sqrt(expected * (1 - expected) / 400)


def test_stretches_weigh_alike_and_too_few_of_them_give_the_largest_error():
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


def test_each_group_has_a_factor_and_thresholds_of_its_own():
    rng = np.random.default_rng(3)
    groups, squared = np.repeat([0, 1], [50, 50]), np.concatenate((rng.chisquare(6, 50), 100 * rng.chisquare(6, 50)))
    scores = np.repeat(np.concatenate((rng.random(50), np.full(50, np.inf)))[:, None], 7, axis=1)
    both = PathRule(path_rule(CELLS, 0.1).calibrate_scores(scores), 0.2, squared, groups)
    for group, rows in ((0, slice(None, 50)), (1, slice(50, None))):
        alone = PathRule(path_rule(CELLS, 0.1).calibrate_scores(scores[rows]), 0.2, squared[rows], groups[rows])
        asked = np.array([group])
        np.testing.assert_array_equal(both.thresholds(asked), alone.calibration.thresholds_[None])
        assert both.variance_factors(asked) == pytest.approx(alone.variance_factors(asked))
    assert np.isfinite(both.thresholds(np.array([0, 1]))).all(axis=1).tolist() == [True, False]


def test_groups_keep_recognition_when_rooms_get_other_numbers():
    recognised, rooms = np.array([True, False, True, False]), np.array([0, 0, 1, 2])
    groups = path_groups(recognised, rooms)
    assert len(np.unique(groups)) == 4
    number = np.array([0, 0, 1])  # two rooms have grown together
    np.testing.assert_array_equal(renumber_rooms(groups, number), path_groups(recognised, number[rooms]))
    np.testing.assert_array_equal(path_groups(recognised), path_groups(recognised, np.zeros(4, int)))
