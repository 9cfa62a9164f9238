import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from conformodal.conformal import QuantileBins, SplitConformal
from conformodal.conformal.checks import BinProbabilities
from conformodal.conformal.scores import Aps
from conformodal.geometry import fix_sign
from conformodal.localizer.cells import BEYOND, BeliefCells, divide_bins
from conformodal.localizer.evidence import PoseMeasurement
from conformodal.localizer.fusion import fuse
from conformodal.localizer.localizer import RECOGNISED, Beliefs, recognised_only
from conformodal.localizer.mixtures import PoseMixture

SIGN = np.array([1.0, 0, 0, 0])


@pytest.fixture(scope="module")
def bins():
    rng = np.random.default_rng(0)
    quats = Rotation.from_rotvec(0.3 * rng.normal(size=(300, 3))).as_quat(scalar_first=True)
    return QuantileBins(10).fit(np.column_stack((rng.gamma(2, size=(300, 3)), quats)))


def softmaxes(bins, n, seed=1):
    rng = np.random.default_rng(seed)
    return [rng.dirichlet(np.ones(k), n).astype(np.float32) for k in bins.sizes]


def estimate(place, turn=(0.1, 0.2, -0.1), sigma_m=0.02, sigma_rad=0.01, probability=0.9):
    quat = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
    return PoseMeasurement(np.array(place, float), quat, sigma_m, sigma_rad, 50, probability)


def mixture(*answers):
    """Of one mode and of what sources say."""
    mode = PoseMixture.weighted(np.zeros((1, 3)), np.ones((1, 3)), SIGN[None], np.ones(1), np.zeros(1), measured=False)
    return fuse(mode, answers)


def beliefs(proba, *mixtures):
    return Beliefs(proba, mixtures, [[] for _ in mixtures])


def marginals(bins, proba, *mixtures, sign=SIGN):
    return beliefs(proba, *mixtures).marginals(BeliefCells.of(bins, divide_bins(bins), sign))


def test_cells_hold_the_edges_of_the_bins_and_reach_beyond(bins):
    cells = divide_bins(bins)
    for edges, fine in zip(bins.edges_, cells.edges_, strict=True):
        assert np.isin(edges, fine).all()
        reach, widths = np.ptp(edges), np.diff(fine)
        assert fine[0] < edges[0] - 2 * reach
        assert fine[-1] > edges[-1] + 2 * reach
        assert (np.diff(widths[-BEYOND:]) > 0).all()  # wider the further away
        np.testing.assert_allclose(widths[:BEYOND], widths[-BEYOND:][::-1])
        assert len(widths) == 800 + 2 * BEYOND
    many = QuantileBins(900).fit(np.linspace(0, 1, 5000))
    assert divide_bins(many).sizes == [900 + 2 * BEYOND]


@pytest.mark.parametrize("depth_m", [3.0, np.nan])
def test_estimates_of_a_target_that_never_changes_are_within_the_cells(depth_m):
    """A wheeled robot: one height, and no roll."""
    rng = np.random.default_rng(3)
    values = np.column_stack(
        (rng.uniform(0, 4, (500, 2)), np.full(500, 0.3), rng.uniform(-1, 1, (500, 2)), np.zeros((500, 2)))
    )
    cells = divide_bins(QuantileBins(50).fit(values), depth_m)
    found = np.tile(values[:1], (1000, 1))
    found[:, 2] += rng.normal(0, 0.01, 1000)
    found[:, 5:] += rng.normal(0, 0.005, (1000, 2))
    assert (cells.encode(found) >= 0).all()
    assert (cells.encode(values[:1] + 5 * np.eye(7)[2])[:, 2] < 0).all()
    assert np.diff(cells.edges_[2]).min() < 1e-6


def test_rooms_far_away_change_no_region_by_more_than_a_cell():
    rng, cell_m, ends = np.random.default_rng(0), 2 / 400, []
    room = np.column_stack((rng.uniform(0, 4, (500, 3)), rng.uniform(-1, 1, (500, 4))))
    for shifts in ([0], [0, 50, 2000, 3000]):
        bins = QuantileBins(50).fit(np.concatenate([room + shift * (np.arange(7) < 3) for shift in shifts]))
        cells, proba = divide_bins(bins, depth_m=2.0), softmaxes(bins, 1)
        parts = beliefs(proba, mixture([estimate([1.0, 2.0, 3.0])])).marginals(BeliefCells.of(bins, cells, SIGN))
        shares = beliefs(proba, mixture()).marginals(BeliefCells.of(bins, cells, SIGN))
        for p, rows, coarse, fine in zip(proba, shares, bins.edges_, cells.edges_, strict=True):
            within = np.add.reduceat(rows, np.searchsorted(fine, coarse), axis=1)
            np.testing.assert_allclose(within[:, :-1], p, rtol=1e-6)
        widths = np.diff(cells.edges_[0])[BEYOND:-BEYOND]
        assert np.mean(widths <= cell_m) > 0.7  # but between rooms
        regions = SplitConformal(cells, 0.2, "hpd", "max").regions_at(BinProbabilities(parts), np.full(7, 0.7))
        ends.append(regions.intervals(0)[:3])
    np.testing.assert_allclose(ends[1], ends[0], atol=cell_m)


def test_rows_add_up_to_one_whatever_is_believed(bins):
    far = estimate([1e3, -1e3, 0.0])  # most of it lies beyond the cells
    three = mixture([estimate([0.5, 1, 1]), far], [estimate([0.51, 1, 1], probability=0.3)])
    for rows in marginals(bins, softmaxes(bins, 3), mixture(), three, mixture([far])):
        assert rows.shape == (3, 1400)
        assert (rows >= 0).all()
        np.testing.assert_allclose(rows.sum(axis=1), 1, rtol=1e-12)


def test_without_estimates_the_softmax_is_spread_evenly(bins):
    proba, cells = softmaxes(bins, 5), divide_bins(bins)
    for j, found in enumerate(marginals(bins, proba, *[mixture()] * 5)):
        inside = (cells.edges_[j][:-1] >= bins.edges_[j][0]) & (cells.edges_[j][1:] <= bins.edges_[j][-1])
        assert not found[:, ~inside].any()
        # probabilities of 32 bits add up to one but for their last digit
        even = np.repeat(proba[j] / 80, 80, axis=1)
        np.testing.assert_allclose(found[:, inside], even, rtol=1e-6)
        # the density is that of the bins
        density = (found / cells.widths[j])[:, inside].reshape(5, bins.sizes[j], -1)
        np.testing.assert_allclose(
            density, np.broadcast_to((proba[j] / bins.widths[j])[..., None], density.shape), rtol=1e-5
        )


@pytest.mark.parametrize("probability", [0.05, 0.5, 0.9])
def test_an_estimate_has_its_probability_and_students_tails(bins, probability):
    proba, cells = softmaxes(bins, 3), divide_bins(bins)
    middle = [float(np.median(e)) for e in bins.edges_[:3]]
    its = estimate(middle, probability=probability)
    found = marginals(bins, proba, mixture(), mixture([its]), mixture())
    plain = marginals(bins, proba, *[mixture()] * 3)
    quat = its.orientation_quat_wxyz
    # a small rotation moves a unit quaternion by half of its angle, orthogonally to itself
    scales = [0.02] * 3 + [0.01 / 2 * np.sqrt(1 - q**2) for q in quat]
    for j, (place, scale) in enumerate(zip([*middle, *quat], scales, strict=True)):
        np.testing.assert_array_equal(found[j][[0, 2]], plain[j][[0, 2]])
        mass = np.diff(stats.t(3, place, scale).cdf(cells.edges_[j]))
        expected = (1 - probability) * plain[j][1] + probability * mass
        # differences of a distribution function have sixteen digits behind the point, and no more in the tails
        np.testing.assert_allclose(found[j][1], expected / expected.sum(), rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("sign", [SIGN, -SIGN, np.array([0.0, 0, -1, 0])])
def test_signs_of_quaternions_are_those_of_the_reference(sign):
    """An estimate lies where the targets of its frame lie."""
    bins = QuantileBins.from_edges([np.linspace(-1, 1, 11)] * 7)
    its = estimate([0, 0, 0], probability=0.99)
    (place,) = fix_sign(its.orientation_quat_wxyz[None], sign)
    found = marginals(bins, softmaxes(bins, 1), mixture([its]), sign=sign)
    for rows, q, edges in zip(found[3:], place, divide_bins(bins).edges_[3:], strict=True):
        best = int(rows[0].argmax())
        assert edges[best] <= q <= edges[best + 1]


def test_probable_estimate_recognises_a_place():
    unsure, sure = (estimate([0, 0, 0], probability=RECOGNISED - 0.01), estimate([1, 0, 0], probability=RECOGNISED))
    given = [[], [unsure], [unsure, sure], [sure]]
    assert Beliefs([], [mixture()] * 4, given).recognised.tolist() == [False, False, True, True]
    assert [recognised_only(its) for its in given] == [[], [], [sure], [sure]]


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    n_places=st.integers(1, 4),
    sigma_m=st.sampled_from([1e-4, 0.01, 0.1, 1.0]),
    probability=st.sampled_from([0.3, 0.9, 0.999]),
    limits=st.lists(st.sampled_from([-np.inf, 0.2, 0.6, 0.9, 0.98, np.inf]), min_size=7, max_size=7),
    single=st.booleans(),
)
def test_the_level_set_near_hypotheses_is_that_of_all_cells(bins, seed, n_places, sigma_m, probability, limits, single):
    rng = np.random.default_rng(seed)
    cells = BeliefCells.of(bins, divide_bins(bins), SIGN)
    low, high = np.array([(edges[0], edges[-1]) for edges in bins.edges_[:3]]).T
    places = rng.uniform(1.5 * low - 0.5 * high, 1.5 * high - 0.5 * low, (n_places, 3))  # some are beyond the bins
    answers = [estimate(place, rng.normal(size=3), sigma_m, sigma_m, probability) for place in places]
    dtype = np.float32 if single else np.float64
    its, proba = mixture(answers), [part.astype(dtype) for part in softmaxes(bins, 1, seed)]
    rule, limits = SplitConformal(divide_bins(bins), 0.1, "hpd", "max"), np.array(limits)
    expected = rule.regions_at(BinProbabilities(beliefs(proba, its).marginals(cells)), limits)
    found = cells.level_set(np.concatenate(proba, axis=1)[0], its, Aps("density", 0.5), limits)
    if found is None:  # as where the limit is beyond what is near
        assert limits.max() > 0.6 or probability < 0.5 or sigma_m > 0.1 or n_places > 1
        return
    for mask, near in zip(expected.masks, cells.by_target(found[None]), strict=True):
        np.testing.assert_array_equal(near, mask)


def test_the_level_set_of_a_recognised_place_is_found_nearby(bins):
    cells = BeliefCells.of(bins, divide_bins(bins), SIGN)
    middle = [float(np.median(edges)) for edges in bins.edges_[:3]]
    its, proba = mixture([estimate(middle, probability=0.99)]), np.concatenate(softmaxes(bins, 1), axis=1)[0]
    found = cells.level_set(proba, its, Aps("density", 0.5), np.full(7, 0.9))
    assert 7 < found.sum() < 0.2 * len(found)
    assert cells.level_set(proba, mixture(), Aps("density", 0.5), np.full(7, 0.9)) is None
    assert cells.level_set(proba, its, Aps("probability", 0.5), np.full(7, 0.9)) is None
