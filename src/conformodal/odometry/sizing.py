"""How hard a recording is, told without its truth: the radius of the chosen pose is resized by it.

A system whose answers to neighbouring frames contradict each other is further off than one whose answers do not. This
is what the resized sets of Duchi, Gupta, Jiang and Sur ("Predictive inference in multi-environment scenarios",
arXiv:2403.16336) ask for: little, known of the new environment, that tells its difficulty. The form here is fixed and
learns nothing from the truth of any recording, so a promise calibrated on resized errors stays exact.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from conformodal.conformal.checks import Alpha, as_alpha
from conformodal.core import FloatArray
from conformodal.core.choices import as_member
from conformodal.poses import Trajectory

from .errors import OdometryError
from .settings import SIZING

METRES_PER_RAD = SIZING.metres_per_rad


class Sizing(StrEnum):
    """What makes a radius larger in one recording than in another."""

    NONE = "none"  # nothing: one radius for all
    ROUGHNESS = "roughness"  # how far answers are from what their neighbours in time say


def depth_or_default(depth_m: float) -> float:
    """How many metres weigh as much as one radian: the depth of the scene, or the default where that is NaN."""
    return depth_m if np.isfinite(depth_m) else METRES_PER_RAD


def check_metres_per_rad(metres_per_rad: float) -> float:
    """The same number, checked.

    Raises
    ------
    OdometryError
        If it is not positive and finite.
    """
    if not (metres_per_rad > 0 and np.isfinite(metres_per_rad)):
        raise OdometryError(f"metres_per_rad must be positive and finite, got {metres_per_rad}")
    return metres_per_rad


def joint_error(position_m: npt.ArrayLike, angle_rad: npt.ArrayLike, metres_per_rad: float) -> FloatArray:
    """One error of a pose in radians: the larger of its angle and its distance over `metres_per_rad`."""
    return np.maximum(np.asarray(position_m, dtype=np.float64) / metres_per_rad, angle_rad)


def roughness(trajectory: Trajectory, metres_per_rad: float = METRES_PER_RAD) -> FloatArray:
    """How far every pose of one recording is from the one that its two neighbours give for its time.

    Parameters
    ----------
    trajectory
        n poses of one recording, in the order of time.
    metres_per_rad
        See :func:`joint_error`.

    Returns
    -------
    numpy.ndarray
        (n - 2,) joint errors in radians: the first and the last pose have one neighbour only. Empty if n < 3.
    """
    if len(trajectory) < 3:
        return np.empty(0)
    before, here, after = slice(None, -2), slice(1, -1), slice(2, None)
    times, places = trajectory.timestamps_s, trajectory.positions_xyz
    turns = Rotation.from_quat(trajectory.orientations_quat_wxyz, scalar_first=True)
    share = ((times[here] - times[before]) / (times[after] - times[before]))[:, None]
    place = places[before] + share * (places[after] - places[before])
    turn = turns[before] * Rotation.from_rotvec(share * (turns[before].inv() * turns[after]).as_rotvec())
    metres = np.linalg.norm(places[here] - place, axis=1)
    return joint_error(metres, (turn.inv() * turns[here]).magnitude(), metres_per_rad)


def recording_size(
    trajectory: Trajectory, sizing: Sizing | str, alpha: Alpha, metres_per_rad: float = METRES_PER_RAD
) -> float:
    """Size of one recording by its answers: its radius is so many times that of a recording of size 1.

    The fourth root of the 1 - `alpha` quantile of its :func:`roughness`, in units of a hundredth of a radian. The
    quantile is the one that the radius is about.

    Parameters
    ----------
    trajectory
        Answered frames of one recording, in the order of time.
    sizing
        ``none`` gives 1.
    alpha
        Miscoverage rate of the radius.
    metres_per_rad
        See :func:`joint_error`.

    Returns
    -------
    float
        Positive; 1 where fewer than three frames were answered, so that there is no roughness.

    Raises
    ------
    OdometryError
        If `sizing` is not one of :class:`Sizing`.
    """
    sizing = as_member(sizing, Sizing, "sizing", OdometryError)
    if sizing is Sizing.NONE or len(trajectory) < 3:
        return 1.0
    rough = np.quantile(roughness(trajectory, metres_per_rad), 1 - float(as_alpha(alpha)))
    return float((max(float(rough), SIZING.least_rad) / SIZING.reference_rad) ** SIZING.power)
