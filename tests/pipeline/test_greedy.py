"""The paper's reasoning against its equations, tried on every combination of intervals."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.geometry import MotionStatus, RelativeMotion
from conformodal.localizer.candidates import BinRuns
from conformodal.localizer.observations import PosePath
from conformodal.pipeline.paper import Greedy


def some_intervals(rng, counts):
    """Intervals in no order, with probabilities in another."""
    return [BinRuns(rng.normal(size=m), rng.uniform(0.1, 0.2, m), np.log(rng.dirichlet(np.ones(m)))) for m in counts]


def greedy(intervals, motions):
    path = Greedy()
    frames = enumerate(zip(intervals, motions, strict=True))
    return PosePath.concatenate([path.push(*frame, float(t)) for t, frame in frames])


def means(runs):
    return [of.mean for of in runs]


def masses(runs):
    return [of.log_mass for of in runs]


def some_motions(rng, n):
    turns = Rotation.random(n, rng=rng).as_matrix()
    headings = rng.normal(size=(n, 3))
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    return [None, *(RelativeMotion(MotionStatus.OK, turns[t], headings[t]) for t in range(1, n))]


def brute_force(intervals, motions):
    """Section 3 of the paper, word by word: all combinations, one by one."""
    path = []
    for t, here in enumerate(intervals):
        places = np.array(list(product(*means(here)[:3])))
        quats = np.array(list(product(*means(here)[3:])))
        if t == 0:
            mass = [sum(c) for c in product(*masses(here)[:3])], [sum(c) for c in product(*masses(here)[3:])]
            p, q = places[np.argmax(mass[0])], quats[np.argmax(mass[1])]
        else:
            p_prev, q_prev = path[-1]
            R_prev = Rotation.from_quat(q_prev, scalar_first=True).as_matrix()
            q_next = Rotation.from_matrix(R_prev @ motions[t].R_prev_next).as_quat(scalar_first=True)
            off = [min(np.linalg.norm(q - q_next), np.linalg.norm(q + q_next)) for q in quats]
            t_rel = R_prev @ motions[t].direction_prev
            miss = [np.linalg.norm(t_rel - (p - p_prev) / np.linalg.norm(p - p_prev)) for p in places]
            p, q = places[np.argmin(miss)], quats[np.argmin(off)]
        path.append((p, q / np.linalg.norm(q)))
    return np.array([p for p, _ in path]), np.array([q for _, q in path])


@pytest.mark.parametrize("seed", range(12))
def test_all_combinations_are_tried(seed):
    rng = np.random.default_rng(seed)
    intervals = [some_intervals(rng, rng.integers(1, 6, 7)) for _ in range(8)]
    motions = some_motions(rng, 8)
    found = greedy(intervals, motions)
    positions, quats = brute_force(intervals, motions)
    np.testing.assert_array_equal(found.positions_xyz, positions)
    np.testing.assert_allclose(found.orientations_quat_wxyz, quats, atol=1e-15)


@pytest.mark.parametrize("motion", [None, RelativeMotion(MotionStatus.LOST)])
def test_the_most_probable_is_taken_where_motion_is_unknown(motion):
    rng = np.random.default_rng(1)
    intervals = [some_intervals(rng, [3] * 7) for _ in range(4)]
    found = greedy(intervals, [motion] * 4)
    best = np.array([[m[np.argmax(mass)] for m, mass in zip(means(i), masses(i), strict=True)] for i in intervals])
    np.testing.assert_array_equal(found.positions_xyz, best[:, :3])
    expected = best[:, 3:] / np.linalg.norm(best[:, 3:], axis=1, keepdims=True)
    np.testing.assert_allclose(found.orientations_quat_wxyz, expected)
