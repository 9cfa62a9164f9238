"""How large the errors of candidates are, learnt from frames with known poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.stats import theilslopes

from conformodal.poses import Trajectory, angle_between_quats

from .candidates import Candidates, SpreadScale

FloatArray = npt.NDArray[np.float64]
# Medians of |N(0, 1)| and of the length of a standard normal vector in three dimensions.
_MEDIAN_OF_ABS_NORMAL, _MEDIAN_OF_NORM3 = 0.6745, 1.5382
_MAX_GROWTH = 2.0


def fit_spread_scale(
    candidates: Sequence[Candidates], truth: Trajectory, strangeness: FloatArray | None = None
) -> SpreadScale:
    """Sizes of errors in units of spreads, from frames that no network was trained on.

    Takes the candidate nearest to the truth, and medians, so that wrong modes do not count as wide ones.

    Parameters
    ----------
    candidates
        Of n frames, not scaled.
    truth
        Their poses.
    strangeness
        (n,) how little is known of such images, 1 where it is typical; None where nothing says.
    """
    z_position, z_orientation = [], []
    for c, p, q in zip(candidates, truth.positions_xyz, truth.orientations_quat_wxyz, strict=True):
        k = int(np.argmin(np.linalg.norm(c.positions_xyz - p, axis=1)))
        z_position.append((c.positions_xyz[k] - p) / c.position_spreads[k])
        angle = angle_between_quats(c.orientations_quat_wxyz, q)
        k = int(np.argmin(angle))
        z_orientation.append(angle[k] / c.orientation_spreads_rad[k])
    positions, turns = np.array(z_position), np.array(z_orientation)
    growth = 0.0
    if strangeness is not None:
        growth = fit_growth(np.linalg.norm(positions, axis=1), strangeness)
        positions, turns = positions / strangeness[:, None] ** growth, turns / strangeness**growth
    x, y, z = np.maximum(np.median(np.abs(positions), axis=0) / _MEDIAN_OF_ABS_NORMAL, 0.05)
    turn = max(float(np.median(turns)) / _MEDIAN_OF_NORM3, 0.05)
    return SpreadScale((float(x), float(y), float(z)), turn, growth)


def fit_growth(errors: FloatArray, strangeness: FloatArray) -> float:
    """The power of strangeness (n,) with which errors (n,) grow, 0 to 2: the median slope of their logarithms."""
    there = (errors > 0) & (strangeness > 0)
    x, y = np.log(strangeness[there]), np.log(errors[there])
    if len(x) < 2 or np.ptp(x) == 0:
        return 0.0
    return float(np.clip(theilslopes(y, x)[0], 0, _MAX_GROWTH))
