import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from conformodal.conformal import QuantileBins, Regions, SplitConformal
from conformodal.poses import PoseFix
from conformodal.reasoning import fix_cells, on_cells, pool_fixes

SIGN = np.array([1.0, 0, 0, 0])


@pytest.fixture
def bins():
    rng = np.random.default_rng(0)
    quats = Rotation.from_rotvec(0.3 * rng.normal(size=(300, 3))).as_quat(scalar_first=True)
    return QuantileBins(10).fit(np.column_stack((rng.gamma(2, size=(300, 3)), quats)))


def softmaxes(bins, n, seed=1):
    rng = np.random.default_rng(seed)
    return [rng.dirichlet(np.ones(k), n).astype(np.float32) for k in bins.sizes]


def fix(place, turn=(0.1, 0.2, -0.1), sigma_m=0.02, sigma_rad=0.01, trust=0.9):
    return PoseFix(
        np.array(place), Rotation.from_rotvec(turn).as_quat(scalar_first=True), sigma_m, sigma_rad, 50, trust
    )


def test_cells_hold_the_edges_of_the_bins_and_reach_beyond(bins):
    cells = fix_cells(bins)
    for edges, fine in zip(bins.edges_, cells.edges_, strict=True):
        assert np.isin(edges, fine).all()
        reach = np.ptp(edges)
        assert fine[0] == pytest.approx(edges[0] - reach / 2)
        assert fine[-1] == pytest.approx(edges[-1] + reach / 2)
        assert len(fine) - 1 == 2 * 800
    many = QuantileBins(900).fit(np.linspace(0, 1, 5000))
    assert fix_cells(many).sizes == [2 * 900]


def test_regions_over_bins_are_the_same_over_cells(bins):
    proba = softmaxes(bins, 40)
    for score in ("density", "linear_density"):
        rule = SplitConformal(bins, 0.3, score).calibrate(
            proba, np.column_stack([e[3:4].repeat(40) for e in bins.edges_])
        )
        alone = rule.predict(proba)
        cells = SplitConformal(fix_cells(bins), 0.3, score).cells
        fine = Regions(cells, [on_cells(m, bins, j) for j, m in enumerate(alone.masks)], alone.unbounded)
        np.testing.assert_allclose(fine.length, alone.length)
        np.testing.assert_array_equal(fine.n_intervals, alone.n_intervals)


def test_without_fixes_the_softmax_is_spread_evenly(bins):
    proba, cells = softmaxes(bins, 5), fix_cells(bins)
    for j, pooled in enumerate(pool_fixes(proba, [[]] * 5, bins, cells, SIGN)):
        inside = (cells.edges_[j][:-1] >= bins.edges_[j][0]) & (cells.edges_[j][1:] <= bins.edges_[j][-1])
        np.testing.assert_allclose(pooled.sum(axis=1), 1)
        assert not pooled[:, ~inside].any()
        # the density is that of the bins
        density = (pooled / cells.widths[j])[:, inside].reshape(5, bins.sizes[j], -1)
        np.testing.assert_allclose(
            density, np.broadcast_to((proba[j] / bins.widths[j])[..., None], density.shape), rtol=1e-5
        )


def test_a_fix_has_the_share_it_is_trusted_with_and_students_tails(bins):
    proba, cells = softmaxes(bins, 3), fix_cells(bins)
    middle = [float(np.median(e)) for e in bins.edges_[:3]]
    pooled = pool_fixes(proba, [[], [fix(middle)], []], bins, cells, SIGN)
    plain = pool_fixes(proba, [[], [], []], bins, cells, SIGN)
    np.testing.assert_array_equal(pooled[0][[0, 2]], plain[0][[0, 2]])
    for j in range(3):
        law = stats.t(3, middle[j], 0.02)
        mass = np.diff(law.cdf(cells.edges_[j]))
        expected = 0.1 * plain[j][1] + 0.9 * mass
        np.testing.assert_allclose(pooled[j][1], expected / expected.sum(), rtol=1e-6)


def test_quaternions_spread_as_small_turns_spread_them_whatever_their_sign(bins):
    proba, cells = softmaxes(bins, 1), fix_cells(bins)
    turn = np.array([0.5, -0.3, 0.2])
    here = fix([1.0, 1.0, 1.0], turn=turn, sigma_rad=0.02, trust=0.99)
    flipped = PoseFix(here.position_xyz, -here.orientation_quat_wxyz, 0.02, 0.02, 50, 0.99)
    one, other = (pool_fixes(proba, [[f]], bins, cells, SIGN) for f in (here, flipped))
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(0.02 * stats.t(3).rvs(size=(200_000, 3), random_state=rng))
    samples = (Rotation.from_rotvec(turn) * turns).as_quat(scalar_first=True)
    for j in range(3, 7):
        np.testing.assert_array_equal(one[j], other[j])
        cumulative = np.cumsum(one[j][0])
        for share in (0.25, 0.75):  # quartiles of the pooled law are those of turned quaternions
            at = cells.edges_[j][1:][np.searchsorted(cumulative, share)]
            spread = np.subtract(*np.quantile(samples[:, j - 3], [0.75, 0.25]))
            assert abs(at - np.quantile(samples[:, j - 3], share)) < 0.25 * spread + cells.widths[j].max()


def test_of_several_fixes_one_at_most_is_right(bins):
    proba, cells = softmaxes(bins, 1), fix_cells(bins)
    two = [fix([0.5, 1, 1], trust=0.8, sigma_m=1e-3), fix([3.0, 1, 1], trust=0.5, sigma_m=1e-3)]
    pooled = pool_fixes(proba, [two], bins, cells, SIGN)[0][0]
    plain = pool_fixes(proba, [[]], bins, cells, SIGN)[0][0]
    centers = cells.centers[0]
    shares = [pooled[np.abs(centers - x) < 0.3].sum() for x in (0.5, 3.0)]
    # odds of 4 : 1 : 1 for the first, the second, and neither
    without = [plain[np.abs(centers - x) < 0.3].sum() / 6 for x in (0.5, 3.0)]
    assert shares == pytest.approx([4 / 6 + without[0], 1 / 6 + without[1]], abs=0.01)


def test_no_images_have_no_rows(bins):
    cells = fix_cells(bins)
    assert [p.shape for p in pool_fixes(softmaxes(bins, 0), [], bins, cells, SIGN)] == [(0, k) for k in cells.sizes]
