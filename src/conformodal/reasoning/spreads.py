"""How large the errors of candidates are, learnt from frames with known poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from conformodal.poses import Trajectory, angle_between_quats

from .candidates import Candidates, SpreadScale

# Medians of |N(0, 1)| and of the length of a standard normal vector in three dimensions.
_MEDIAN_OF_ABS_NORMAL, _MEDIAN_OF_NORM3 = 0.6745, 1.5382


def fit_spread_scale(candidates: Sequence[Candidates], truth: Trajectory) -> SpreadScale:
    """Sizes of errors in units of spreads, from frames that no network was trained on.

    Takes the candidate nearest to the truth, and medians, so that wrong modes do not count as wide ones.

    Parameters
    ----------
    candidates
        Of n frames, not scaled.
    truth
        Their poses.
    """
    z_position, z_orientation = [], []
    for c, p, q in zip(candidates, truth.positions_xyz, truth.orientations_quat_wxyz, strict=True):
        k = int(np.argmin(np.linalg.norm(c.positions_xyz - p, axis=1)))
        z_position.append((c.positions_xyz[k] - p) / c.position_spreads[k])
        angle = angle_between_quats(c.orientations_quat_wxyz, q)
        k = int(np.argmin(angle))
        z_orientation.append(angle[k] / c.orientation_spreads_rad[k])
    x, y, z = np.maximum(np.median(np.abs(z_position), axis=0) / _MEDIAN_OF_ABS_NORMAL, 0.05)
    turn = max(float(np.median(z_orientation)) / _MEDIAN_OF_NORM3, 0.05)
    return SpreadScale((float(x), float(y), float(z)), turn)
