"""The covariance of the chosen pose, from the belief that it was chosen from."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.core.choices import as_member
from conformodal.reasoning.candidates import Candidates
from conformodal.running.estimates import Estimate

from .conventions import Covariance
from .errors import RosError

_LEAST_VARIANCE = 1e-12  # m^2 and rad^2: a covariance can be inverted


def pose_covariance(estimate: Estimate, kind: Covariance) -> FloatArray:
    """Covariance (6, 6) of an estimate's pose, in m^2, m rad and rad^2.

    The first three are x, y and z of the world. The others are small rotations about x, y and z of the world, which do
    not turn with the camera: the true orientation is ``exp(r) R_world_cam``.

    Raises
    ------
    RosError
        If `kind` is not one of :class:`Covariance`.
    """
    kind = as_member(kind, Covariance, "covariance", RosError)
    pose = estimate.pose
    candidates = estimate.candidates if estimate.posterior is None else estimate.posterior.hypotheses
    assert pose is not None
    assert candidates is not None
    if kind is Covariance.MIXTURE:
        return mixture_covariance(candidates, pose.positions_xyz[0], pose.orientations_quat_wxyz[0])
    assert estimate.position_spread_m is not None
    assert estimate.orientation_spread_rad is not None
    own = estimate.position_spread_m**2 / 3, estimate.orientation_spread_rad**2
    return np.diag(np.maximum(np.repeat(own, 3), _LEAST_VARIANCE))


def mixture_covariance(candidates: Candidates, position_xyz: FloatArray, quat_wxyz: FloatArray) -> FloatArray:
    """Second moments (6, 6) of a belief around a pose: that of each candidate, and how far off the candidate is.

    Parameters
    ----------
    candidates
        A mixture of normal densities.
    position_xyz, quat_wxyz
        (3,) and (4,) the pose.
    """
    weights = weights_of(candidates)
    chosen = Rotation.from_quat(quat_wxyz, scalar_first=True)
    turned = (Rotation.from_quat(candidates.orientations_quat_wxyz, scalar_first=True) * chosen.inv()).as_rotvec()
    off = np.concatenate((candidates.positions_xyz - position_xyz, turned), axis=1)
    turning = np.repeat(candidates.orientation_spreads_rad[:, None], 3, axis=1)
    spreads = np.concatenate((candidates.position_spreads, turning), axis=1)
    found = (weights[:, None] * off).T @ off + np.diag(weights @ spreads**2 + _LEAST_VARIANCE)
    return np.asarray((found + found.T) / 2)


def weights_of(candidates: Candidates) -> FloatArray:
    """Probabilities (m,) that sum to one."""
    share = np.exp(candidates.log_mass - candidates.log_mass.max())
    return np.asarray(share / share.sum())
