"""Standard deviations and inlier probabilities, learnt from errors that are drawn with known laws."""

import numpy as np
import pytest
from scipy.stats import theilslopes
from sklearn.linear_model import LogisticRegression

from conformodal.localizer.evidence import HeldOutErrors, PoseMeasurement, fit_error_model

ANYWHERE = 1e9  # metres: every estimate is of the same place


def lengths(n, seed):
    """Of standard normal vectors in three dimensions."""
    return np.linalg.norm(np.random.default_rng(seed).normal(size=(n, 3)), axis=1)


def held_out(error_m, sigma_m=1.0, error_rad=None, sigma_rad=1.0, distance=0.0, support=None, weights=1.0):
    error_m = np.asarray(error_m, float)
    n = len(error_m)
    whole = (np.broadcast_to(np.asarray(value, float), n) for value in (sigma_m, sigma_rad, distance, weights))
    sigma_m, sigma_rad, distance, weights = whole
    error_rad = 0.01 * lengths(n, 99) if error_rad is None else np.asarray(error_rad, float)
    support = np.ones((n, 1)) if support is None else support
    return HeldOutErrors(error_m, sigma_m, error_rad, sigma_rad, distance, support, weights)


def estimate(sigma=1.0, distance=0.0):
    return PoseMeasurement(np.zeros(3), np.array([1.0, 0, 0, 0]), sigma, sigma, 50, distance_to_known=distance)


def test_error_growth_with_sigma_and_distance_is_learnt():
    rng = np.random.default_rng(0)
    sigma, distance = np.exp(rng.normal(size=(2, 3000)))
    found = fit_error_model(
        held_out(
            0.3 * sigma**1.2 * distance**0.5 * lengths(3000, 1),
            sigma,
            0.001 * sigma**0.4 * distance**0.8 * lengths(3000, 2),
            sigma,
            distance,
        ),
        ANYWHERE,
    )
    # a slope over 3000 points of spread one, around which logarithms scatter by 0.45, is good to 0.01
    law = (found.position_growth, found.position_distance, found.rotation_growth, found.rotation_distance)
    assert law == pytest.approx((1.2, 0.5, 0.4, 0.8), abs=0.04)
    assert (found.position, found.rotation) == pytest.approx((0.3, 0.001), rel=0.05)
    applied = found.apply(estimate(2.0, 3.0), 1.0)
    assert applied.sigma_m == pytest.approx(0.3 * 2**1.2 * 3**0.5, rel=0.1)
    assert applied.sigma_rad == pytest.approx(0.001 * 2**0.4 * 3**0.8, rel=0.1)


@pytest.mark.parametrize(("power", "growth"), [(-1, 0.0), (0, 0.0), (0.5, 0.5), (1, 1.0), (3, 2.0)])
@pytest.mark.parametrize("cause", ["sigma_m", "distance"])
def test_errors_grow_with_their_cause_as_far_as_that_is_credible(cause, power, growth):
    values = np.geomspace(1, 100, 40)
    found = fit_error_model(held_out(values**power, **{cause: values}), ANYWHERE)
    assert (found.position_growth if cause == "sigma_m" else found.position_distance) == pytest.approx(growth)
    assert (found.position_distance if cause == "sigma_m" else found.position_growth) == pytest.approx(0)


@pytest.mark.parametrize(("heavy", "by_tail"), [(0.0, False), (0.1, True)])
def test_sigma_fits_the_larger_of_median_and_tail(heavy, by_tail):
    errors = 0.1 * lengths(4000, 3) * np.where(np.random.default_rng(4).random(4000) < heavy, 6, 1)
    found = fit_error_model(held_out(errors), ANYWHERE).position
    by = np.median(errors) / 1.5382, np.quantile(errors, 0.95) / 2.7955
    assert found == pytest.approx(max(by))
    assert (by[1] > 1.5 * by[0]) == by_tail


def test_estimates_of_other_places_are_outliers():
    """They do not enlarge the errors of measurement."""
    errors = 0.1 * lengths(200, 5)
    clean = fit_error_model(held_out(errors), 2.0)
    elsewhere = np.concatenate((errors, np.full(100, 30.0)))
    found = fit_error_model(held_out(elsewhere, error_rad=np.resize(0.01 * lengths(200, 99), 300)), 2.0)
    assert found.position == clean.position
    turned = np.concatenate((0.01 * lengths(200, 99), np.full(100, 2.0)))
    rotated = fit_error_model(held_out(np.concatenate((errors, errors[:100])), error_rad=turned), 2.0)
    assert (rotated.position, rotated.rotation) == (clean.position, clean.rotation)
    for model, outliers in ((clean, 0), (found, 100), (rotated, 100)):
        # one inlier and one outlier are added, so that neither is ever certain
        inliers = 200 + 1
        expected = inliers / (inliers + outliers + 1)
        assert model.apply(estimate(), 1.0).inlier_probability == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("n", "learnt"), [(19, False), (20, True)])
def test_a_model_is_learnt_from_twenty_estimates_near_the_truth(n, learnt):
    errors = np.concatenate((np.full(n, 0.1), np.full(100, 30.0)))
    assert (fit_error_model(held_out(errors), 2.0) is not None) == learnt


def test_support_predicts_inlier_probability():
    rng = np.random.default_rng(6)
    support = np.exp(rng.normal(size=(5000, 2)))
    inlier = rng.random(5000) < 1 / (1 + np.exp(-(0.5 + 1.5 * np.log(support[:, 0]))))
    errors = np.where(inlier, 0.1 * lengths(5000, 7), 30.0)
    found = fit_error_model(held_out(errors, support=support), 2.0)
    assert (found.log_odds, *found.slopes) == pytest.approx((0.5, 1.5, 0.0), abs=0.1)
    few, many = (found.apply(estimate(), share, 1.0).inlier_probability for share in (0.3, 3.0))
    assert few < 0.5 < many


def test_no_support_lowers_the_probability_of_an_inlier():
    """The second support is larger for outliers; the fit is the best among slopes that are not negative."""
    rng = np.random.default_rng(8)
    log_support, weights = rng.normal(size=(400, 2)), rng.uniform(0.05, 1, 400)
    inlier = rng.random(400) < 1 / (1 + np.exp(-(1 + log_support @ (1.0, -1.0))))
    errors = np.where(inlier, 0.1 * lengths(400, 9), 30.0)
    found = fit_error_model(held_out(errors, support=np.exp(log_support), weights=weights), 2.0)
    assert found.slopes[0] > 0.5
    assert found.slopes[1] == 0
    alone = held_out(errors, support=np.exp(log_support[:, :1]), weights=weights)
    expected = fit_error_model(alone, 2.0)
    assert (found.log_odds, found.slopes[0]) == pytest.approx((expected.log_odds, *expected.slopes), abs=1e-4)
    x, w = np.append(log_support[:, 0], np.full(2, np.median(log_support[:, 0]))), np.append(weights, [1, 1])
    reference = LogisticRegression(tol=1e-10).fit(x[:, None], np.append(inlier, [True, False]), sample_weight=w)
    assert expected.log_odds == pytest.approx(reference.intercept_[0], abs=1e-4)
    assert expected.slopes == pytest.approx(reference.coef_[0], abs=1e-4)


@pytest.mark.parametrize("n", [30, 2000])
def test_growth_is_theil_sens_slope(n):
    rng = np.random.default_rng(n)
    cause = np.exp(np.round(rng.normal(size=n), 1))  # some are equal
    error = cause**0.7 * np.exp(rng.normal(size=n))
    found = fit_error_model(held_out(error, distance=cause), ANYWHERE)
    assert found.position_distance == pytest.approx(theilslopes(np.log(error), np.log(cause))[0], rel=1e-12)
