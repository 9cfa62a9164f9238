"""A short flight, and beliefs about it that name other places too."""

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.geometry import MotionStatus, RelativeMotion
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import MotionPrior

PRIOR = MotionPrior(0.5, (0.1, 0.2), (1.5, 1.5), (0.5, 0.5))


def path(n=40):
    t = np.arange(n) * 0.1
    positions = np.column_stack((np.sin(t), 0.4 * t, 0.1 * np.cos(2 * t)))
    rotations = Rotation.from_euler("zyx", np.column_stack((0.4 * t, 0.1 * np.sin(t), 0 * t)))
    return t, positions, rotations


def exact_motions(positions, rotations):
    motions = [None]
    for t in range(1, len(positions)):
        R = rotations[t - 1].inv() * rotations[t]
        step = rotations[t - 1].inv().apply(positions[t] - positions[t - 1])
        direction, spreads = step / np.linalg.norm(step), np.radians([0.3, 8])
        motions.append(RelativeMotion(MotionStatus.OK, R.as_matrix(), direction, 100, 100, *spreads))
    return motions


def ambiguous(positions, rotations, seed=0, period=4.0, favour=0.0):
    """Candidates at the truth and one period on either side; `favour` makes the wrong ones more probable."""
    rng = np.random.default_rng(seed)
    quats = rotations.as_quat(scalar_first=True)
    found = []
    for p, q in zip(positions, quats, strict=True):
        noisy = p + rng.normal(size=3) * 0.05
        options = noisy + np.array([[0, 0, 0], [period, 0, 0], [-period, 0, 0]])
        mass = np.log(np.repeat([0.4 - favour, 0.3 + favour, 0.3], 2) / 2)
        turned = Rotation.from_rotvec([0, 0, np.pi / 2]) * Rotation.from_quat(q, scalar_first=True)
        orientations = np.tile([-q, turned.as_quat(scalar_first=True)], (3, 1))
        order = np.argsort(-mass, kind="stable")
        places = np.repeat(options, 2, axis=0)[order]
        found.append(
            PoseMixture.weighted(places, np.full((6, 3), 0.05), orientations[order], np.full(6, 0.02), mass[order])
        )
    return found
