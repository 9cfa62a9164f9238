"""Regions of poses are nested unions of cuboids, and agree with their scores."""

import numpy as np
import pytest

from conformodal.conformal import QuantileBins, Regions, SplitConformal
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.regions import Support, pose_regions, pose_scores

N, CELLS = 40, 12
EDGES = [np.linspace(0, 1, CELLS + 1)] * 3 + [np.linspace(-1, 1, CELLS + 1)] * 4
BINS = QuantileBins.from_edges(EDGES)
SIGN = np.array([1.0, 0.0, 0.0, 0.0])


def hypotheses(rng, m):
    quats = rng.normal(size=(m, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    log_mass = np.log(rng.dirichlet(np.ones(m)))
    return PoseMixture.weighted(rng.random((m, 3)), np.full((m, 3), 0.1), quats, np.full(m, 0.1), log_mass)


@pytest.fixture(scope="module")
def beliefs():
    rng = np.random.default_rng(0)
    proba = [rng.dirichlet(np.full(CELLS, 0.3), size=N) for _ in EDGES]
    supports = [Support.of(hypotheses(rng, rng.integers(1, 6)), BINS, SIGN) for _ in range(N)]
    targets = np.column_stack((rng.random((N, 3)), rng.uniform(-1, 1, (N, 4))))
    return proba, supports, targets


def rule_of(joint="max", score="hpd", alpha=0.1):
    rule = SplitConformal(BINS, alpha, score, joint)
    rule.set_scale()
    return rule


def supported_by_hand(rule, proba, supports, targets, level):
    """Membership from the definition: walk from the pose to every hypothesis that counts, along each target alone."""
    scores = [rule.scores_of(p, w) for p, w in zip(proba, BINS.widths, strict=True)]
    codes, held = BINS.encode(targets), []
    for i, support in enumerate(supports):
        its = zip(support.cells, support.levels, strict=True)
        held.append(
            any(
                counts <= level
                and all((scores[j][i, min(a, b) : max(a, b) + 1] <= level).all() for j, (a, b) in enumerate(pairs))
                for pairs, counts in ((list(zip(cells, codes[i], strict=True)), counts) for cells, counts in its)
            )
        )
    return np.array(held)


@pytest.mark.parametrize("level", [0.3, 0.6, 0.8, 0.9, 0.97, 0.9999, 1.0])
def test_region_contains_poses_scored_within_the_level(beliefs, level):
    proba, supports, targets = beliefs
    rule = rule_of()
    scores = pose_scores(rule, proba, supports, targets)
    regions = pose_regions(rule, proba, supports, np.full(7, level))
    expected = supported_by_hand(rule, proba, supports, targets, level)
    np.testing.assert_array_equal(regions.contains(targets, joint=True), expected)
    np.testing.assert_array_equal((scores <= level).all(axis=1), expected)
    # the product of the targets' sets holds no less, and the projections are within its sets
    product = rule.regions_at(proba, np.full(7, level))
    assert (product.contains(targets, joint=True) >= expected).all()
    assert all((a <= b).all() for a, b in zip(regions.masks, product.masks, strict=True))
    assert (regions.volume <= Regions.volume.fget(product) + 1e-12).all()


def test_a_threshold_at_a_score_holds_that_pose(beliefs):
    proba, supports, targets = beliefs
    rule = rule_of()
    scores = pose_scores(rule, proba, supports, targets)
    rule.calibrate_scores(scores)
    regions = pose_regions(rule, proba, supports, rule.thresholds_)
    held = regions.contains(targets, joint=True)
    own = scores.max(axis=1)
    assert held.sum() == np.sum(own <= np.sort(own)[rule.rank - 1])


def test_places_are_disjoint_boxes_around_hypotheses(beliefs):
    proba, supports, _ = beliefs
    regions = pose_regions(rule_of(), proba, supports, np.full(7, 0.97))
    for i, support in enumerate(supports):
        places = regions.places(i)
        assert len(places) == regions.n_places[i]
        probabilities = [place.probability for place in places]
        assert probabilities == sorted(probabilities, reverse=True)
        assert sum(probabilities) <= 1 + 1e-9
        codes = {tuple(box.ravel()) for box in regions.boxes[i]}
        assert len(codes) == len(places)
        for place in places:
            positions = support.mixture.positions_xyz[support.rows]
            its = (positions >= place.box[:3, 0]) & (positions <= place.box[:3, 1])
            assert its.all(axis=1).any()


def test_a_region_holds_the_poses_in_its_cuboids(beliefs):
    proba, supports, targets = beliefs
    regions = pose_regions(rule_of(), proba, supports, np.full(7, 0.9))
    for i in range(N):
        held = regions[np.full(N, i)].contains(targets, joint=True)
        edges = regions.box_edges(i)
        inside = (edges[None, :, :, 0] <= targets[:, None]) & (targets[:, None] < edges[None, :, :, 1])
        np.testing.assert_array_equal(held, inside.all(axis=2).any(axis=1))


def test_an_infinite_threshold_holds_every_pose(beliefs):
    proba, supports, _ = beliefs
    regions = pose_regions(rule_of(), proba, supports, np.full(7, np.inf))
    far = np.full((N, 7), 1e9)
    assert regions.contains(far, joint=True).all()
    assert np.isinf(regions.volume).all()
    assert np.isinf(regions.places(0)[0].box).all()


def test_per_target_calibration_gives_the_product_region(beliefs):
    proba, supports, targets = beliefs
    rule = rule_of("none", "lac")
    np.testing.assert_array_equal(pose_scores(rule, proba, supports, targets), rule.score_samples(proba, targets))
    limits = np.linspace(0.7, 0.99, 7)
    regions, product = pose_regions(rule, proba, supports, limits), rule.regions_at(proba, limits)
    np.testing.assert_array_equal(regions.contains(targets, joint=True), product.contains(targets, joint=True))
    third = np.full(N, 3)
    np.testing.assert_array_equal(
        regions[third].contains(targets, joint=True), product[third].contains(targets, joint=True)
    )
    assert (regions.volume == product.volume).all()


def test_hypotheses_beyond_the_cells_support_nothing():
    its = PoseMixture.weighted(np.array([[5.0, 5, 5]]), np.ones((1, 3)), SIGN[None], np.ones(1), np.zeros(1))
    support = Support.of(its, BINS, SIGN)
    assert not len(support.levels)
    assert support.out_of_range
    assert not Support.of(hypotheses(np.random.default_rng(0), 3), BINS, SIGN).out_of_range
    proba = [np.full((1, CELLS), 1 / CELLS)] * 7
    targets = np.full((1, 7), 0.5)
    assert np.isinf(pose_scores(rule_of(), proba, [support], targets).max())
    assert not pose_regions(rule_of(), proba, [support], np.ones(7)).contains(targets, joint=True).any()
