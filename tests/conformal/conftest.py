import numpy as np
import pytest

from conformodal.conformal import QuantileBins


def make_problem(seed, n=60, d=2, k=7, dtype=np.float64):
    """Bins of unequal widths, random probabilities, values in, on the edges of, and outside the bins."""
    rng = np.random.default_rng(seed)
    bins = QuantileBins.from_edges([np.cumsum(rng.uniform(0.1, 2, k + 1)) for _ in range(d)])
    proba = rng.dirichlet(np.full(k, 0.5), size=(n, d)).astype(dtype)
    y = np.column_stack([rng.uniform(e[0] - 0.3, e[-1] + 0.3, n) for e in bins.edges_])
    for j, e in enumerate(bins.edges_):
        y[: k + 1, j] = e
    return bins, proba, y


@pytest.fixture(scope="session")
def problem():
    """The function that makes a problem from a seed."""
    return make_problem
