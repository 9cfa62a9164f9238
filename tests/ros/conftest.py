"""Estimates made by hand."""

import numpy as np
import pytest

from conformodal.conformal import QuantileBins, Regions
from conformodal.odometry import Estimate, EvidenceKind
from conformodal.poses import Trajectory
from conformodal.reasoning import Candidates


def random_candidates(rng, m=4):
    quats = rng.normal(size=(m, 4))
    mass = rng.dirichlet(np.ones(m))
    order = np.argsort(-mass)
    return Candidates(
        rng.normal(size=(m, 3)) * (1, 2, 3),
        rng.uniform(0.05, 0.5, (m, 3)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        rng.uniform(0.01, 0.1, m),
        np.log(mass[order]),
    )


def some_region(rng, n_bins=12, unbounded=False):
    """Of one frame: 12 bins of half a metre an axis, some of them in the set."""
    edges = [np.linspace(-3, 3, n_bins + 1)] * 3 + [np.linspace(-1, 1, n_bins + 1)] * 4
    masks = [rng.random((1, n_bins)) < 0.5 for _ in edges]
    return Regions(QuantileBins.from_edges(edges), masks, np.full((1, 7), unbounded))


@pytest.fixture
def some_candidates():
    return random_candidates


@pytest.fixture
def make_estimate():
    """Gives an estimate at a time; `kind` None is a frame without an image."""

    def make(time_s=1.5, kind=EvidenceKind.GLOBAL, seed=0, revised=None, candidates=None, region=None, **given):
        if kind is None:
            return Estimate(time_s, None, None, None, None, None, False, "no image")
        rng = np.random.default_rng(seed)
        found = random_candidates(rng) if candidates is None else candidates
        pose = Trajectory([time_s], found.positions_xyz[:1], found.orientations_quat_wxyz[:1])
        unknown = kind is EvidenceKind.UNKNOWN
        given = {"position_spread_m": 0.3, "orientation_spread_rad": 0.05, "known_p": 0.5, **given}
        return Estimate(
            time_s,
            pose,
            pose if revised is None else revised,
            some_region(rng, unbounded=unknown) if region is None else region,
            found,
            None,
            not unknown,
            "like no place that is known" if unknown else "",
            evidence=kind,
            **given,
        )

    return make
