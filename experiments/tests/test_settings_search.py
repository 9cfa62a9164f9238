import math
from dataclasses import replace

import pytest

from conformodal.vision.settings import TrainingConfig
from experiments.regressors import RATES, SettingsSearch
from experiments.tasks import ExperimentError


def far_from(best_rate):
    """Error in steps of rates; less without dropout."""
    return lambda s: abs(RATES.index(s.learning_rate) - RATES.index(best_rate)) + s.dropout


def at(rate, dropout=0.3):
    return TrainingConfig(learning_rate=rate, dropout=dropout)


@pytest.mark.parametrize("best", RATES)
@pytest.mark.parametrize("starts", [(1e-3, 3e-3), (1e-2,), (1e-5,), (1e-1,)])
def test_a_walk_ends_at_the_best_rate_between_two_worse_ones(best, starts):
    search = SettingsSearch(far_from(best))
    search.walk(*map(at, starts))
    assert search.best == at(best)
    k = RATES.index(best)
    assert {at(rate) for rate in RATES[max(k - 1, 0) : k + 2]} <= set(search.errors)


def test_a_second_walk_is_its_own_though_the_first_was_better():
    search = SettingsSearch(lambda s: far_from(1e-2)(s) if s.dropout else 10 + far_from(1e-4)(s))
    search.walk(at(1e-3))
    search.walk(replace(search.best, dropout=0.0))
    assert at(1e-4, 0.0) in search.errors
    assert search.best == at(1e-2)


def test_nothing_is_trained_twice():
    trained = []
    search = SettingsSearch(lambda s: trained.append(s) or s.dropout)
    search.try_out(at(1e-3), at(1e-3), at(1e-3, 0.1))
    search.try_out(at(1e-3, 0.1), at(1e-3, 0.0))
    assert trained == [at(1e-3), at(1e-3, 0.1), at(1e-3, 0.0)]
    assert search.best == at(1e-3, 0.0)


@pytest.mark.parametrize("broken", [math.nan, math.inf, -math.inf])
def test_a_training_that_broke_down_is_never_the_best(broken):
    search = SettingsSearch(lambda s: broken if s.dropout else 5.0)
    search.try_out(at(1e-3), at(1e-3, 0.0))
    assert search.best == at(1e-3, 0.0)


def test_where_the_last_training_breaks_down_the_next_best_settings_take_over():
    search = SettingsSearch(lambda s: {0.3: 1.0, 0.1: 2.0, 0.0: 3.0}[s.dropout])
    search.try_out(at(1e-3), at(1e-3, 0.1), at(1e-3, 0.0))
    errors = {0.3: math.nan, 0.1: 4.1, 0.0: 5.9}
    assert search.once_more(lambda s: s.dropout, errors.__getitem__) == (at(1e-3, 0.0), 0.0)
    assert search.once_more(lambda s: s.dropout, lambda _: 0.1) == (at(1e-3), 0.3)
    assert search.once_more(lambda s: s.dropout, lambda _: math.inf) == (at(1e-3), 0.3)  # nothing is better


def test_nothing_is_trained_on_more_before_anything_was_tried():
    with pytest.raises(ExperimentError, match="tried out"):
        SettingsSearch(lambda _: 1.0).once_more(lambda s: s, lambda _: 0.0)
