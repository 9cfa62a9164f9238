"""Places: the hypotheses of a posterior that mean the same pose, taken together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray
from conformodal.geometry import Trajectory, angle_between_quats, fix_sign, normalise_quat

from .candidates import Candidates
from .filter import Posterior
from .observations import Observations, PosePath
from .prior import MotionPrior
from .settings import FILTER


@dataclass(frozen=True, eq=False)
class Place:
    """One place where the camera may be.

    Attributes
    ----------
    probability
        Posterior mass of its hypotheses.
    position_xyz, position_spreads
        (3,) metres, world: mean and standard deviations.
    orientation_quat_wxyz, orientation_spread_rad
        (4,) world from camera, and the standard deviation of each component of a small rotation.
    box
        (7, 2) lower and upper ends of the targets' intervals, of a place of a calibrated region; None of others.
    """

    probability: float
    position_xyz: FloatArray
    position_spreads: FloatArray
    orientation_quat_wxyz: FloatArray
    orientation_spread_rad: float
    box: FloatArray | None = None

    @property
    def covariance(self) -> FloatArray:
        """(6, 6) covariance of position in metres and small rotation in radians, world axes."""
        variances = np.concatenate((self.position_spreads**2, np.full(3, self.orientation_spread_rad**2)))
        return np.asarray(np.diag(variances))


def find_places(posterior: Posterior, prior: MotionPrior) -> list[Place]:
    """The places of a posterior, most probable first; their probabilities and that of elsewhere sum to one.

    Going down from the most probable hypothesis, each joins the first place whose most probable hypothesis is near: by
    a share of the scene's depth, which the prior gives.
    """
    hypotheses = posterior.hypotheses.normalised(np.log1p(-posterior.elsewhere))
    free = np.argsort(-hypotheses.log_mass, kind="stable")
    places = []
    while free.size:
        first, rest = hypotheses.take(free[:1]), hypotheses.take(free)
        joins = same_place(rest, first.positions_xyz[0], first.orientations_quat_wxyz[0], prior)
        joins[0] = True
        places.append(summarise(rest.take(np.flatnonzero(joins))))
        free = free[~joins]
    return sorted(places, key=lambda place: -place.probability)


def same_place(
    poses: Candidates | PosePath | Trajectory, positions_xyz: FloatArray, quats_wxyz: FloatArray, prior: MotionPrior
) -> BoolArray:
    """(m,) whether each of m poses is of the place of one pose, (3,) and (4,), or of its own, (m, 3) and (m, 4)."""
    off = np.linalg.norm(poses.positions_xyz - positions_xyz, axis=1)
    turned = angle_between_quats(poses.orientations_quat_wxyz, quats_wxyz)
    return np.asarray((off <= prior.place_m) & (turned <= FILTER.place_rad))


def summarise(hypotheses: Candidates, box: FloatArray | None = None) -> Place:
    """One place by the first two moments of hypotheses hypotheses, of which there is at least one."""
    mass = np.exp(hypotheses.log_mass)
    share = mass / mass.sum()
    position = share @ hypotheses.positions_xyz
    variance = share @ (hypotheses.position_spreads**2 + (hypotheses.positions_xyz - position) ** 2)
    quat = normalise_quat(share @ fix_sign(hypotheses.orientations_quat_wxyz, hypotheses.orientations_quat_wxyz[0]))
    apart = angle_between_quats(hypotheses.orientations_quat_wxyz, quat)
    angle = float(np.sqrt(share @ (hypotheses.orientation_spreads_rad**2 + apart**2 / 3)))
    return Place(float(mass.sum()), position, np.sqrt(variance), quat, angle, box)


def choose_places(
    posteriors: Sequence[Posterior], timestamps_s: FloatArray, prior: MotionPrior
) -> tuple[PosePath, FloatArray]:
    """The mean of each frame's most probable place, and the (n,) probabilities of these places."""
    best = [find_places(posterior, prior)[0] for posterior in posteriors]
    path = PosePath(
        np.asarray(timestamps_s, dtype=np.float64),
        np.array([place.position_xyz for place in best]),
        np.array([place.position_spreads for place in best]),
        np.array([place.orientation_quat_wxyz for place in best]),
        np.array([place.orientation_spread_rad for place in best]),
    )
    return path, np.array([place.probability for place in best])


def image_hypotheses(path: PosePath, seen: Observations, prior: MotionPrior) -> PosePath:
    """The hypotheses of single images that a path of :func:`choose_places` stands for, with spreads of the images.

    This is what a smoother starts from: it weighs in the neighbours in time itself. An image that shows no known place
    says little of its pose, and gets wide spreads.
    """
    positions, spreads = path.positions_xyz.copy(), path.position_spreads.copy()
    quats, turns = path.orientations_quat_wxyz.copy(), path.orientation_spreads_rad.copy()
    for t, hypotheses in enumerate(seen.candidates):
        rows = np.flatnonzero(same_place(hypotheses, positions[t], quats[t], prior))
        if rows.size:
            off2 = ((hypotheses.positions_xyz[rows] - positions[t]) ** 2).sum(axis=1)
            wide2 = (hypotheses.position_spreads[rows] ** 2).sum(axis=1) + (spreads[t] ** 2).sum()
            best = rows[np.argmax(hypotheses.log_mass[rows] - 0.5 * off2 / wide2)]
            positions[t], spreads[t] = hypotheses.positions_xyz[best], hypotheses.position_spreads[best]
            quats[t], turns[t] = hypotheses.orientations_quat_wxyz[best], hypotheses.orientation_spreads_rad[best]
    unknown = ~seen.is_known
    spreads[unknown] = np.maximum(spreads[unknown], FILTER.unknown_spread * prior.scale_m)
    turns[unknown] = np.maximum(turns[unknown], FILTER.unknown_spread_rad)
    return PosePath(path.timestamps_s, positions, spreads, quats, turns)
