"""Calibration of regions from the frames so far and in hindsight, on held-out stretches that are run as streams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, RealArray, Rows, rows_by_label
from conformodal.core.parallel import in_workers, raise_if_cancelled
from conformodal.geometry import RelativeMotion
from conformodal.io import SplitKind
from conformodal.localizer.filter import filter_posteriors, hindsight_posteriors
from conformodal.localizer.localizer import Beliefs, Localizer
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import MotionPrior, Observations, Posterior, find_places
from conformodal.localizer.regions import RegionRules
from conformodal.localizer.rooms import Rooms, part_of
from conformodal.localizer.training_data import TrainingData

from .calibrate import CalibratedRegions, out_of_range, score_beliefs
from .folds import Folds
from .model import HINDSIGHT, ONLINE, PATHS, PathRule, path_rule

_MAX_SQUARED = 1e9  # error over its covariance: more is as wrong


@dataclass(frozen=True, eq=False)
class PathScores(Rows):
    """Scores of n frames under posteriors."""

    scores: RealArray  # (n, 7)
    lost: BoolArray  # (n,) whether the region is unbounded
    unseen_s: FloatArray  # (n,) to the nearest frame whose image shows a known place
    squared: FloatArray  # (n,) squared errors of the chosen poses over the covariances of the posteriors
    known_p: FloatArray  # (n,) p-values of the images; 0 of those out of range
    rooms: IntArray  # (n,) by the posteriors; 0 where there is one

    @classmethod
    def of(
        cls,
        localizer: Localizer,
        beliefs: Beliefs,
        posteriors: Sequence[Posterior],
        targets: FloatArray,
        prior: MotionPrior,
        rooms: Rooms | None,
        known_p: FloatArray,
    ) -> Self:
        """Of targets (n, 7), from beliefs about the images, their p-values (n,), and posteriors."""
        observed = zip(posteriors, beliefs.mixtures, targets, strict=True)
        rule, after = path_rule(localizer.cells, 0.1), beliefs.after(posteriors)  # no score depends on the rate
        return cls(
            score_beliefs(rule, localizer, after, targets),
            np.array([one.lost for one in posteriors]) | out_of_range(localizer, after),
            np.array([one.unseen_s for one in posteriors]),
            np.array([squared_error(one, image, target, prior) for one, image, target in observed]),
            known_p,
            np.zeros(len(targets), dtype=np.int64) if rooms is None else rooms.rooms_of(after.mixtures),
        )


def squared_error(posterior: Posterior, image: PoseMixture, target: FloatArray, prior: MotionPrior) -> float:
    """The squared error of the pose that is chosen from a posterior over its covariance, see Estimate.covariance."""
    pose = find_places(posterior, prior)[0]
    covariance = posterior.with_image(image).covariance(pose.position_xyz, pose.orientation_quat_wxyz)
    truth, chosen = (Rotation.from_quat(quat, scalar_first=True) for quat in (target[3:], pose.orientation_quat_wxyz))
    off = np.concatenate((target[:3] - pose.position_xyz, (truth * chosen.inv()).as_rotvec()))
    return float(np.clip(off @ np.linalg.solve(covariance, off), 1 / _MAX_SQUARED, _MAX_SQUARED))


def calibrate_paths(
    data: TrainingData,
    folds: Folds,
    localizers: Sequence[Localizer],
    calibrated: CalibratedRegions,
    prior: MotionPrior,
    motions: dict[int, RelativeMotion | None],
    rooms: Rooms | None = None,
) -> dict[str, PathRule]:
    """Rules of regions from posteriors, by path. `motions` are those between held-out frames.

    Each stretch or recording that calibrates is run as a stream, at the recording's rate, by sources that had not seen
    it. The guarantee, for a random frame of a new stretch that is run from its first frame, is approximate: the motion
    prior and the cells know the held-out poses.

    Where single frames calibrate and are drawn like the test frames, the held-out ones of each recording are a stream.
    They calibrate streams of about as many other frames drawn so: with more frames a second, posteriors are sharper.
    Where frames calibrate but stretches are held out, there are no such rules.
    """
    if folds.units is None and data.split.kind is not SplitKind.INTERLEAVED:
        return {}
    rules, units = calibrated.rules, folds.units
    ends = np.cumsum([len(fold.held_out) for fold in folds.folds])[:-1]
    known, known_p = np.split(rules.shows_known_place, ends), np.split(rules.known_p, ends)
    frames = [fold.held_out for fold in folds.folds]
    held_out = list(map(_HeldOutBeliefs, frames, localizers, calibrated.beliefs, known, known_p))
    streams = data.sequence.recording if units is None else units
    score = partial(_score_paths, data.targets, data.sequence.timestamps_s, streams, motions, prior, rooms)
    scored = in_workers(score, held_out)
    of_units = None if units is None else units[np.concatenate([one.frames for one in scored])]
    return {
        path: make_path_rule(rules, PathScores.concatenate([one.paths[path] for one in scored]), of_units)
        for path in PATHS
    }


class _HeldOutBeliefs(NamedTuple):
    """Frames that a localizer has not seen, and its beliefs about them."""

    frames: IntArray
    localizer: Localizer
    beliefs: Beliefs
    known: BoolArray  # whether they show known places
    known_p: FloatArray  # by which they do


class _ScoredPaths(NamedTuple):
    """Frames, stream by stream, and their scores by path."""

    frames: IntArray
    paths: dict[str, PathScores]


def _score_paths(
    targets: FloatArray,
    timestamps_s: FloatArray,
    streams: IntArray,
    motions: dict[int, RelativeMotion | None],
    prior: MotionPrior,
    rooms: Rooms | None,
    held_out: _HeldOutBeliefs,
) -> _ScoredPaths:
    """Run streams of held-out frames and score them; targets, times and labels of streams are of all frames."""
    posteriors: dict[str, list[Posterior]] = {path: [] for path in PATHS}
    order = rows_by_label(streams[held_out.frames])
    for rows in order:
        frames = held_out.frames[rows]
        observations = Observations(
            [held_out.beliefs.mixtures[i] for i in rows.tolist()],
            [motions[frame] for frame in frames.tolist()],
            timestamps_s[frames],
            known=held_out.known[rows],
        )
        forward = filter_posteriors(observations, prior)
        posteriors[ONLINE] += forward
        posteriors[HINDSIGHT] += hindsight_posteriors(observations, prior, forward)
        raise_if_cancelled()
    rows = np.concatenate(order)
    frames, beliefs, known_p = held_out.frames[rows], held_out.beliefs.part(rows), held_out.known_p[rows]
    return _ScoredPaths(
        frames,
        {
            path: PathScores.of(held_out.localizer, beliefs, each, targets[frames], prior, rooms, known_p)
            for path, each in posteriors.items()
        },
    )


def make_path_rule(rules: RegionRules, scored: PathScores, units: IntArray | None) -> PathRule:
    """From scores of n frames in `units` (n,), None if frames are exchangeable."""
    rule = path_rule(rules.overall.bins, rules.overall.alpha)
    rule.calibrate_scores(scored.scores, units)
    found = ~scored.lost
    longest_gap_s = float(scored.unseen_s[found].max(initial=0.0))
    squared, known_p, rooms = scored.squared[found], scored.known_p[found], scored.rooms[found]
    return PathRule(part_of(rule, found), longest_gap_s, squared, known_p, rules.level, rooms)
