import tracemalloc
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

from conformodal.conformal import ConformalError, conformal_quantile, conformal_rank
from conformodal.conformal.checks import as_reals


def exact(n: int, thousandths: int) -> int:
    return -(-(n + 1) * (1000 - thousandths) // 1000)


@pytest.mark.parametrize("n", [*range(1, 40), 99, 100, 199, 499, 500, 999, 1000, 1999, 2000])
def test_rank_is_exact_for_every_alpha_in_thousandths(n):
    found = [conformal_rank(n, a / 1000) for a in range(1, 1000)]
    assert found == [exact(n, a) for a in range(1, 1000)]


def test_float_arithmetic_would_miss_ranks():
    # the reason for rational arithmetic: the obvious formula is wrong in many of these cases
    wrong = sum(int(np.ceil((n + 1) * (1 - a / 1000))) != exact(n, a) for n in range(1, 400) for a in range(1, 1000))
    assert wrong > 100


@pytest.mark.parametrize("alpha", [0.1, "0.1", Decimal("0.1"), Fraction(1, 10), np.float32(0.1), np.float64(0.1)])
def test_alpha_is_read_as_the_decimal_it_is_written_as(alpha):
    assert conformal_rank(9, alpha) == 9
    assert conformal_rank(19, alpha) == 18


@pytest.mark.parametrize("alpha", [0, 1, -0.1, 90, "x", None, True, float("nan"), [0.1]])
def test_alpha_outside_the_unit_interval_is_refused(alpha):
    with pytest.raises(ConformalError, match="alpha"):
        conformal_rank(10, alpha)


def test_percentage_gets_a_hint():
    with pytest.raises(ConformalError, match=r"did you mean 0\.1"):
        conformal_rank(10, 90)


@pytest.mark.parametrize("n", [-1, 2.5, "3", True])
def test_count_must_be_a_whole_number(n):
    with pytest.raises(ConformalError, match="n must be"):
        conformal_rank(n, 0.1)


def test_quantile_is_the_kth_smallest_and_keeps_its_type():
    scores = np.random.default_rng(0).random((57, 3)).astype(np.float32)
    k = conformal_rank(57, 0.13)
    found = conformal_quantile(scores, 0.13)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.sort(scores, axis=0)[k - 1])
    np.testing.assert_array_equal(conformal_quantile(scores.T, 0.13, axis=1), found)


def test_quantile_is_infinite_where_data_is_short():
    assert conformal_quantile(np.zeros(8), 0.1) == np.inf
    assert conformal_quantile(np.zeros(9), 0.1) == 0
    assert conformal_quantile(np.empty((0, 2)), 0.1).tolist() == [np.inf, np.inf]


def test_quantile_counts_infinite_scores_and_refuses_nan():
    assert conformal_quantile([0.1, np.inf, 0.2], 0.25) == np.inf
    assert conformal_quantile([0.1, np.inf, 0.2], 0.5) == 0.2
    with pytest.raises(ConformalError, match="NaN"):
        conformal_quantile([0.1, np.nan], 0.5)
    with pytest.raises(ConformalError, match="axis"):
        conformal_quantile(0.3, 0.5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_very_many_scores_are_ranked_in_a_file_as_by_sorting(dtype, tmp_path, monkeypatch):
    monkeypatch.setattr("conformodal.conformal.rank.MANY", 1000)
    monkeypatch.setattr("conformodal.conformal.rank._ROWS", 700)
    rng = np.random.default_rng(0)
    drawn = [
        rng.normal(size=5000),
        rng.integers(-3, 4, 5000),  # many ties, and zero
        np.r_[-np.zeros(2500), np.zeros(2500)],
        np.r_[np.full(400, np.inf), np.full(300, -np.inf), rng.normal(size=4300) * 1e-38],
        np.nextafter(dtype(1), dtype(2)) * np.ones(5000),
    ]
    for number, scores in enumerate(drawn):
        file = np.memmap(tmp_path / f"{number}", dtype=dtype, mode="w+", shape=(5000,))
        file[:] = rng.permutation(scores)
        ordered = np.sort(np.array(file))
        for alpha in ("0.0002", "0.001", "0.1", "0.4999", "0.5", "0.9", "0.9998"):
            found = conformal_quantile(file, Fraction(alpha))
            k = conformal_rank(5000, Fraction(alpha))
            assert found.dtype == dtype
            assert float(found) == (ordered[k - 1] if k <= 5000 else np.inf)
    file[17] = np.nan
    with pytest.raises(ConformalError, match="NaN"):
        conformal_quantile(file, 0.1)


def test_a_file_of_scores_is_not_copied(tmp_path):
    file = np.memmap(tmp_path / "scores", dtype=np.float32, mode="w+", shape=(2_000_000,))
    file[:] = np.random.default_rng(0).random(2_000_000, dtype=np.float32)
    assert np.shares_memory(as_reals(file, "scores"), file)
    tracemalloc.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("conformodal.conformal.rank.MANY", 1000)
        patch.setattr("conformodal.conformal.rank._ROWS", 1 << 14)
        conformal_quantile(file, 0.1)
    assert tracemalloc.get_traced_memory()[1] < 0.4 * file.nbytes
    tracemalloc.stop()
