import numpy as np
import pytest
from scipy import stats

from conformodal.conformal import QuantileBins, SplitConformal, check_coverage, conformal_rank, coverage_band
from conformodal.conformal.choice import choose_score


def test_short_calibration_gives_unbounded_regions(problem):
    bins, proba, y = problem(2)
    regions = SplitConformal(bins, 0.1).calibrate(proba[:8], y[:8]).predict(proba)
    assert regions.unbounded.all()
    assert regions.contains(y + 1e9).all()
    assert np.isinf(regions.length).all()
    assert np.isinf(regions.volume).all()
    assert regions.intervals(0)[0].tolist() == [[-np.inf, np.inf]]


def test_coverage_band_is_central_and_exact():
    low, high = coverage_band(99, 50, 0.1, level=0.9)
    law = stats.betabinom(50, 90, 10)
    assert law.cdf(low * 50 - 1) <= 0.05 < law.cdf(low * 50)
    assert law.cdf(high * 50 - 1) < 0.95 <= law.cdf(high * 50)
    assert coverage_band(5, 10, 0.1) == (1.0, 1.0)
    assert check_coverage(np.ones(50, bool), 99, 0.1).coverage == 1
    assert not check_coverage(np.arange(50) < 25, 99, 0.1).inside


SPLITS, M = 1000, 40
TIES = np.array([0.3, 0.2, 0.2, 0.1, 0.1, 0.05, 0.05])


def split_counts(bins, proba_of, draw, n, alpha, shift):
    """Covered of M test values, for each of SPLITS splits; `shift` plants an error in the rank."""
    rng = np.random.default_rng(11)
    counts = np.empty(SPLITS, dtype=int)
    for i in range(SPLITS):
        y, proba = draw(rng, n + M), proba_of(rng, n + M)
        cal = SplitConformal(bins, alpha).calibrate(proba[:n], y[:n])
        if shift and 1 <= cal.rank + shift <= n:
            cal.thresholds_ = np.sort(cal.scores_, axis=0)[cal.rank + shift - 1]
        counts[i] = cal.predict(proba[n:]).contains(y[n:]).sum()
    return counts


def tied_law(share, n, alpha):
    """Law of the covered count if scores take few values, the j-th lowest with probability `share[j]`.

    The threshold is at most the j-th value if at least k calibration scores are; given it, counts are binomial.
    """
    k = conformal_rank(n, alpha)
    reach = np.minimum(np.cumsum(share), 1.0)
    below = stats.binom.sf(k - 1, n, reach)
    at = np.diff(np.concatenate(([0.0], below)))
    law = (at[:, None] * stats.binom.pmf(np.arange(M + 1), M, reach[:, None])).sum(axis=0)
    law[M] += 1 - at.sum()  # no finite threshold: the whole space
    return law


def beta_binomial(n, alpha):
    k = conformal_rank(n, alpha)
    return stats.betabinom.pmf(np.arange(M + 1), M, k, n + 1 - k) if k <= n else np.eye(M + 1)[M]


def p_value(counts, law):
    """Chi-square of the counts, in cells of at least 20 expected."""
    cells, total = np.zeros(M + 1, dtype=int), 0.0
    for i, mass in enumerate(law * SPLITS):
        cells[i:] = cells[i - 1] + 1 if total >= 20 else cells[i]
        total = mass if total >= 20 else total + mass
    expected = np.bincount(cells, law * SPLITS)
    observed = np.bincount(cells[counts], minlength=expected.size)
    if expected.size > 1 and expected[-1] < 20:
        expected, observed = (np.append(a[:-2], a[-2:].sum()) for a in (expected, observed))
    if expected.size == 1:
        return 1.0 if (law[counts] > 0).all() else 0.0
    if (observed[expected == 0] > 0).any():
        return 0.0
    return stats.chisquare(observed, expected * observed.sum() / expected.sum()).pvalue


def uniform(rng, size):
    return rng.uniform(size=size)


def random_rows(k):
    def rows(rng, size):
        noise = rng.exponential(size=(size, k)) ** 3
        return noise / noise.sum(axis=1, keepdims=True)

    return rows


def fixed_row(row):
    return lambda rng, size: np.tile(row, (size, 1))


def from_bins(share):
    return lambda rng, size: rng.choice(share.size, size, p=share) + 0.5


def equal(k):
    return QuantileBins.from_edges([np.linspace(0, 1, k + 1)])


def whole_numbers(k):
    return QuantileBins.from_edges([np.arange(k + 1.0)])


POISSON = np.append(stats.poisson.pmf(np.arange(8), 1.5), stats.poisson.sf(7, 1.5))
CASES = {
    "more bins than samples": (equal(400), random_rows(400), uniform, 29, 0.1, beta_binomial(29, 0.1)),
    "one calibration sample": (equal(300), random_rows(300), uniform, 1, 0.5, beta_binomial(1, 0.5)),
    "too few samples": (equal(50), random_rows(50), uniform, 5, 0.1, beta_binomial(5, 0.1)),
    # lac ranks by probability; equal probabilities tie
    "ties": (whole_numbers(7), fixed_row(TIES), from_bins(TIES), 29, 0.2, tied_law([0.3, 0.4, 0.2, 0.1], 29, 0.2)),
    "repeated values": (
        whole_numbers(9),
        fixed_row(POISSON),
        lambda rng, size: np.minimum(rng.poisson(1.5, size), 8) + 0.0,
        49,
        0.15,
        tied_law(np.sort(POISSON)[::-1], 49, 0.15),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_coverage_follows_its_exact_law(name):
    bins, rows, draw, n, alpha, law = CASES[name]
    assert law.sum() == pytest.approx(1)
    assert p_value(split_counts(bins, rows, draw, n, alpha, 0), law) > 0.001


@pytest.mark.parametrize("name", ["ties", "repeated values"])
@pytest.mark.parametrize("shift", [-1, 1])
def test_an_error_of_one_in_the_rank_does_not(name, shift):
    bins, rows, draw, n, alpha, law = CASES[name]
    assert p_value(split_counts(bins, rows, draw, n, alpha, shift), law) < 1e-4


def chosen_counts(n, alpha, shift):
    """Covered of M test values for each of SPLITS splits, in which training rows choose the score."""
    rng, bins, counts, names = np.random.default_rng(13), equal(40), np.empty(SPLITS, dtype=int), set()
    for i in range(SPLITS):
        # values follow the probabilities of their rows, but those of wide rows are too narrow
        y = rng.beta(*np.exp(rng.normal(1, 1, (2, 120 + n + M))))
        proba = random_rows(40)(rng, y.size) + np.exp(-(((np.arange(40) + 0.5) / 40 - y[:, None]) ** 2) / 0.02)
        proba /= proba.sum(axis=1, keepdims=True)
        score = choose_score([(proba[:120], bins.encode(y[:120])[:, 0])], bins.widths, alpha)
        names.add(score.name)
        cal = SplitConformal(bins, alpha, score).calibrate(proba[120 : 120 + n], y[120 : 120 + n])
        if shift:
            cal.thresholds_ = np.sort(cal.scores_, axis=0)[cal.rank + shift - 1]
        counts[i] = cal.predict(proba[120 + n :]).contains(y[120 + n :]).sum()
    return counts, names


def test_coverage_law_holds_with_a_chosen_score():
    """Training rows choose it."""
    counts, names = chosen_counts(29, 0.2, 0)
    assert len(names) >= 3
    assert p_value(counts, beta_binomial(29, 0.2)) > 0.001
    assert p_value(chosen_counts(29, 0.2, -1)[0], beta_binomial(29, 0.2)) < 1e-4
