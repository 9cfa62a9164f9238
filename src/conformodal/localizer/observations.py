"""What a reasoner is given, and what it gives.

Given are observations of the frames of a recording, and a prior of the camera's motion. It gives a posterior per frame,
whose hypotheses are taken together to places, and a path.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, Rows, rows_by_label
from conformodal.geometry import Pose, RelativeMotion, Submap, Trajectory, angle_between_quats, fix_sign, normalise_quat

from . import LocalizationError
from .mixtures import PoseMixture, Share, pool

# hypotheses of one place are no further from its most probable one than this share of the scene's depth, and turned
# no more than this angle
_PLACE, PLACE_RAD = 0.1, 0.35
# errors of relative rotations beside errors of hypotheses, over what pairs of images claim alone: rotations over
# several frames share the errors of rolling shutters and lenses. Chosen on seeds 20 and 21 of redkitchen
# `interleaved`; one path of the corridor speaks for 1
_ROTATION_SIGMA_FACTOR = 2.0
# statistics of motion are taken of every frame, every second, and so on: they differ by time step
_DECIMATIONS = (1, 2, 4, 8, 16)
_TOP_QUANTILE, _TOP_FACTOR = 0.995, 1.1  # top speed: this quantile of the speeds, times this factor
# changes of velocity above this quantile do not count: a handful of jumps in the given poses must not loosen everything
_USUAL_QUANTILE = 0.98


@dataclass(frozen=True, eq=False)
class Observations:
    """What is known of the n frames of one recording, at least one."""

    candidates: Sequence[PoseMixture]  # of each frame
    # ``motions[t]`` leads from frame t - 1 to frame t, None where nothing is known of it; the first is ignored
    motions: Sequence[RelativeMotion | None]
    timestamps_s: FloatArray  # (n,) seconds, increasing
    submaps: Sequence[Submap] = ()  # of frames numbered 0 to n - 1
    known: BoolArray | None = None  # (n,) whether each image shows a known place; None if all do

    @property
    def is_known(self) -> BoolArray:
        """(n,) whether each image shows a known place."""
        known = np.ones(len(self.candidates)) if self.known is None else self.known
        return np.asarray(known, dtype=np.bool_)


@dataclass(frozen=True)
class MotionPrior:
    """How the camera moves and how deep it looks, learnt in training."""

    turn_rate_rad_s: float  # root mean square
    # time steps that speeds and densities were measured at. Real motion is not white noise: shaking is fast, flying
    # is not
    intervals_s: tuple[float, ...]
    top_speed_mps: tuple[float, ...]  # that hardly any step of that length exceeds
    acceleration_density: tuple[float, ...]  # variance of velocity changes per second, m^2/s^3 and per axis
    depth_m: float = math.nan  # median depth of the corners in view; NaN where it is not known
    depth_spread: float = math.nan  # of its logarithm
    volume_m3: float = 1.0  # of the box around the training positions, at least a millimetre wide

    @property
    def place_m(self) -> float:
        """Distance within which poses are of one place: a share of the depth, or of a metre where it is not known."""
        return _PLACE * self.scale_m

    @property
    def scale_m(self) -> float:
        """The depth; one metre where it is not known."""
        return self.depth_m if math.isfinite(self.depth_m) else 1.0

    def reach_m(self, step_s: float) -> float:
        """How far the camera can get within a time step, in metres."""
        return step_s * float(np.interp(step_s, self.intervals_s, self.top_speed_mps))

    def density_at(self, step_s: FloatArray) -> FloatArray:
        """Velocity-change density for mean time steps (n,), interpolated between the measured ones."""
        logs = np.interp(np.log(step_s), np.log(self.intervals_s), np.log(self.acceleration_density))
        return np.asarray(np.exp(logs))


def rotation_sigma(motion: RelativeMotion) -> float:
    """Standard deviation of a relative rotation in radians, beside the errors of hypotheses."""
    return _ROTATION_SIGMA_FACTOR * motion.rotation_sigma_rad


def fit_motion_prior(truth: Trajectory, recording: IntArray) -> MotionPrior:
    """Learn the prior from the training frames, in order of time; gaps between them are allowed."""
    turns: list[FloatArray] = []
    levels: dict[int, list[FloatArray]] = {}
    for rows in rows_by_label(recording):
        part = truth[rows]
        if len(part) < 3:
            continue
        quats = part.orientations_quat_wxyz
        turns.append(angle_between_quats(quats[1:], quats[:-1]) / np.diff(part.timestamps_s))
        for every in _DECIMATIONS:
            sparse = part[::every]
            if len(sparse) >= 3:
                levels.setdefault(every, []).append(_changes(sparse))
    if not turns:
        raise LocalizationError("a motion prior needs at least three frames of one recording")
    table: list[tuple[float, float, float]] = []
    for every in sorted(levels):
        step, speed, density = np.concatenate(levels[every], axis=1)
        if not table or np.median(step) > table[-1][0]:
            usual = density[density <= np.quantile(density, _USUAL_QUANTILE)].mean()
            top = _TOP_FACTOR * float(np.quantile(speed, _TOP_QUANTILE))
            table.append((float(np.median(step)), top, float(usual)))
    intervals, speeds, densities = zip(*table, strict=True)
    return MotionPrior(
        turn_rate_rad_s=float(np.sqrt(np.mean(np.concatenate(turns) ** 2))) + 1e-9,
        intervals_s=intervals,
        top_speed_mps=tuple(max(v, 1e-9) for v in speeds),
        acceleration_density=tuple(max(q, 1e-12) for q in densities),
        volume_m3=float(np.prod(np.maximum(np.ptp(truth.positions_xyz, axis=0), 1e-3))),
    )


def _changes(part: Trajectory) -> FloatArray:
    """Mean time step, speed, and squared velocity change per second and axis, (3, n - 2)."""
    dt = np.diff(part.timestamps_s)
    velocity = np.diff(part.positions_xyz, axis=0) / dt[:, None]
    step = (dt[1:] + dt[:-1]) / 2
    speed = np.linalg.norm(velocity, axis=1)[1:]
    return np.stack((step, speed, np.sum(np.diff(velocity, axis=0) ** 2, axis=1) / 3 / step))


@dataclass(frozen=True, eq=False)
class Posterior:
    """What is known of a frame's pose: hypotheses, or that it is anywhere."""

    hypotheses: PoseMixture  # most probable first
    elsewhere: float  # probability that none of them is right, and the pose anywhere in the volume
    unseen_s: float = 0.0  # seconds to the nearest frame it rests on whose image shows a known place

    @property
    def lost(self) -> bool:
        """Whether the pose is most probably elsewhere: no known place was seen, or too long ago."""
        return self.elsewhere > 0.5

    def with_image(self, image: PoseMixture, least: float = 0.0) -> PoseMixture:
        """All hypotheses, and after them those of the image alone, which stand where none of these is right.

        The image's have a probability of at least `least`.
        """
        share = max(self.elsewhere, least)
        return pool([Share(self.hypotheses, math.log1p(-share)), Share(image, math.log(share))])


@dataclass(frozen=True, eq=False)
class PosePath(Rows):
    """One pose per frame, with the spreads of its errors."""

    timestamps_s: FloatArray  # (n,)
    positions_xyz: FloatArray  # (n, 3) metres, world
    position_spreads: FloatArray  # (n, 3)
    orientations_quat_wxyz: FloatArray  # (n, 4) world from camera
    orientation_spreads_rad: FloatArray  # (n,)


@dataclass(frozen=True, eq=False)
class UncertainPose(Pose):
    """A pose, with the spreads of its errors."""

    position_spreads: FloatArray  # (3,) standard deviations in metres
    orientation_spread_rad: float  # standard deviation of each component of a small rotation


@dataclass(frozen=True, eq=False)
class Place(UncertainPose):
    """One place where the camera may be: the mean of the hypotheses of a mixture that mean the same pose."""

    probability: float  # weight of its hypotheses
    # (7, 2) lower and upper ends of the targets' intervals, of a place of a calibrated region; None of others
    box: FloatArray | None = None


def find_places(posterior: Posterior, prior: MotionPrior) -> list[Place]:
    """The places of a posterior, most probable first; their probabilities and that of elsewhere sum to one.

    Going down from the most probable hypothesis, each joins the first place whose most probable hypothesis is near: by
    a share of the scene's depth, which the prior gives.
    """
    hypotheses = posterior.hypotheses
    free = np.argsort(-hypotheses.log_weights, kind="stable")
    places = []
    while free.size:
        positions, quats = hypotheses.positions_xyz[free], hypotheses.orientations_quat_wxyz[free]
        joins = _near(positions, quats, positions[0], quats[0], prior)
        joins[0] = True
        place = mean_of(hypotheses, free[joins])
        places.append(replace(place, probability=(1 - posterior.elsewhere) * place.probability))
        free = free[~joins]
    return sorted(places, key=lambda place: -place.probability)


def same_place(
    poses: PoseMixture | PosePath | Trajectory, positions_xyz: FloatArray, quats_wxyz: FloatArray, prior: MotionPrior
) -> BoolArray:
    """(m,) whether each of m poses is of the place of one pose, (3,) and (4,), or of its own, (m, 3) and (m, 4)."""
    return _near(poses.positions_xyz, poses.orientations_quat_wxyz, positions_xyz, quats_wxyz, prior)


def _near(
    positions_xyz: FloatArray, quats_wxyz: FloatArray, place_xyz: FloatArray, place_wxyz: FloatArray, prior: MotionPrior
) -> BoolArray:
    off = np.linalg.norm(positions_xyz - place_xyz, axis=1)
    return np.asarray((off <= prior.place_m) & (angle_between_quats(quats_wxyz, place_wxyz) <= PLACE_RAD))


def mean_of(mixture: PoseMixture, rows: IntArray, box: FloatArray | None = None) -> Place:
    """The place that some hypotheses of a mixture make up, at least one, by their first two moments."""
    weights = mixture.weights[rows]
    share = weights / weights.sum()
    positions, quats = mixture.positions_xyz[rows], mixture.orientations_quat_wxyz[rows]
    position = share @ positions
    variance = share @ (mixture.position_spreads[rows] ** 2 + (positions - position) ** 2)
    quat = normalise_quat(share @ fix_sign(quats, quats[0]))
    apart = angle_between_quats(quats, quat)
    angle = float(np.sqrt(share @ (mixture.orientation_spreads_rad[rows] ** 2 + apart**2 / 3)))
    return Place(position, quat, np.sqrt(variance), angle, float(weights.sum()), box)


def choose_places(posteriors: Sequence[Posterior], timestamps_s: FloatArray, prior: MotionPrior) -> PosePath:
    """The mean of each frame's most probable place."""
    best = [find_places(posterior, prior)[0] for posterior in posteriors]
    return PosePath(
        timestamps_s,
        np.array([place.position_xyz for place in best]),
        np.array([place.position_spreads for place in best]),
        np.array([place.orientation_quat_wxyz for place in best]),
        np.array([place.orientation_spread_rad for place in best]),
    )
