from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

from conformodal.conformal import ConformalError, conformal_quantile, conformal_rank


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
