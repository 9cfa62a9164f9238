import numpy as np
import pytest
from scipy.stats import binom, kstest

from conformodal.conformal import DriftMonitor, QuantileBins, SplitConformal

BINS = QuantileBins.from_edges([np.linspace(0, 1, 11)])
PROBA = np.random.default_rng(0).dirichlet(np.ones(10), 40)


def calibrated(scores, targets=1, joint="none"):
    """A calibrator with given scores (n, d)."""
    bins = QuantileBins.from_edges(BINS.edges_ * targets)
    return SplitConformal(bins, 0.1, "hpd", joint).calibrate_scores(np.reshape(scores, (-1, targets)))


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("targets", [1, 2])
def test_false_alarms_follow_villes_inequality(ties, targets):
    """At most a share delta of exchangeable streams alarms; ranks are uniform, one target's capital is 1 on average."""
    random, streams, delta = np.random.default_rng(targets), 400, 0.2
    alarms, capitals, p_values = 0, [], []
    for seed in range(streams):
        drawn = random.integers(0, 3, (90, targets)) * 1.0 if ties else random.normal(size=(90, 1)) * [1.0] * targets
        monitor = DriftMonitor(calibrated(drawn[:20], targets), delta, seed).update_scores(drawn[20:])
        alarms += monitor.alarm is not None
        capitals.append(monitor.capital)
        p_values.append(np.array(monitor.p_values)[:, 0])
    assert alarms <= binom.ppf(0.999, streams, delta)
    off, error = np.mean(capitals) - 1, 4 * np.std(capitals) / np.sqrt(streams)
    assert off < error
    assert targets > 1 or off > -error
    assert kstest(np.concatenate(p_values), "uniform").pvalue > 1e-3
    assert abs(np.corrcoef(np.array(p_values)[:, :2].T)[0, 1]) < 4 / np.sqrt(streams)  # of one row and the next


@pytest.mark.parametrize(("change", "covers_less"), [(lambda s: s + 1, True), (lambda s: s - 1, False)])
def test_a_change_is_found_with_its_row_and_coverage(change, covers_less):
    scores = np.random.default_rng(0).normal(size=900)
    scores[700:] = change(scores[700:])
    monitor = DriftMonitor(calibrated(scores[:300]), random_state=0).update_scores(scores[300:550, None])
    assert monitor.alarm is monitor.since is monitor.coverage_since is None
    assert str(monitor).endswith("no alarm in 250 rows")
    monitor.update_scores(scores[550:, None])
    assert 400 < monitor.alarm < 460
    assert abs(monitor.since - 400) < 10
    assert (monitor.coverage_since[0] < 0.8) == covers_less


def test_rows_one_by_one_are_rows_together_and_scores_are_those_of_the_calibrator():
    y = np.random.default_rng(1).random(40)
    calibrator = SplitConformal(BINS, 0.3, "density").calibrate(PROBA[:20], y[:20])
    together = DriftMonitor(calibrator, random_state=0).update(PROBA[20:], y[20:])
    single = DriftMonitor(calibrator, random_state=0)
    for row, value in zip(PROBA[20:], y[20:], strict=True):
        single.update(row[None], [value])
    assert single.capital == together.capital != 1
    monitor = DriftMonitor(calibrated(np.zeros((9, 2)), 2, "max")).update_scores(np.array([[0.0, 1.0], [np.inf, 0.0]]))
    assert [len(p) for p in monitor.p_values] == [1, 1]  # one rank for all targets
