"""From the beliefs of single images to one posterior per frame: a Gaussian-sum filter over pose hypotheses.

Each frame's posterior is a mixture. Motion predicts where its hypotheses lead (reach and measured rotation), the next
image's belief weighs them, and hypotheses that explain each other are merged. No mistake is final: a hypothesis that
loses keeps its probability for later evidence. The mass of a place is the sum over its hypotheses, so that a place with
many vague hypotheses is not beaten by one with a single sharp one, as it is in a search for the best path.

Images that follow each other err alike, so a product of two hypotheses is no sharper than the sharper one.

Two passes, one from each end of a recording, give the posterior in hindsight.

Source: Alspach and Sorenson (1972) for the filter, Kitagawa (1994) for the two-filter smoother.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.geometry import RelativeMotion
from conformodal.geometry.poses import trusted_rotation

from .mixtures import MAX_HYPOTHESES, PoseMixture, Share, pool
from .observations import PLACE_RAD, MotionPrior, Observations, Posterior, rotation_sigma

_ROTATIONS = 8 * np.pi**2  # volume of all rotations, in units of small rotation vectors
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])

# These were chosen on seeds 20 and 21 of the demo, 11, 13 and 20 to 23 of redkitchen, and 20 of fr1.
# Images that follow each other err alike: share of an image's evidence that the one directly before has told, and
# seconds in which this share falls by a factor of e. What is left is the power to which the masses of an image's
# places are raised
ALIKE, _ALIKE_S = 0.8, 0.25
# the same for normalisers, as a factor of that power. With 1, a sharp mode of little mass that stays the same over
# many images wins over a vague hypothesis of most of the mass
_SHARPNESS = 0.5
# probability that an image says nothing of the pose, where it shows a known place and where it does not. With 0.5,
# a stretch of images that are all wrong alike soon had a sure path
_WRONG, _WRONG_IF_UNKNOWN = 0.02, 1 - 1e-7
_JUMP = 1e-4  # probability that the camera is anywhere in the next frame: a cut, or a gross mistake
# the same where corners were followed from one frame to the next, which rules a cut out. With 1e-9, a path that a
# few wrong images had led away came back after a dozen right ones
_FOLLOWED_JUMP = 1e-6
_ROTATION_OUTLIER = 1e-6  # probability that a measured relative rotation is an outlier
_MIN_MASS = 1e-10  # hypotheses of less probability are dropped
_FROM_IMAGE = 4  # most probable hypotheses of the newest image that stay beside those of the largest mass
LAG = 10  # frames of a stream whose answer is revised in hindsight


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where the hypotheses of a frame lead, a time step later or earlier."""

    hypotheses: PoseMixture  # turned by the measured rotation, spread by what the camera can have moved and turned
    unturned_quats_wxyz: FloatArray  # (m, 4) and (m,) orientations if the measured rotation is an outlier
    unturned_spreads_rad: FloatArray
    measured: bool  # whether there is a measured rotation
    elsewhere: float  # probability that the camera is anywhere, as after a cut
    unseen_s: float  # seconds since an image showed a known place


def predict(
    neighbour: Posterior, motion: RelativeMotion | None, step_s: float, prior: MotionPrior, *, back: bool = False
) -> Prediction:
    """Predict a frame from the posterior of its neighbour in time, a positive time step away.

    `motion` leads from the earlier frame to the later one, None where nothing is known of it; `back` says that the
    neighbour is the later frame.
    """
    hypotheses = neighbour.hypotheses
    quats, spreads = hypotheses.orientations_quat_wxyz, hypotheses.orientation_spreads_rad
    # a camera that is not seen may go on in one direction: variances grow with the square of the time
    unseen_s = neighbour.unseen_s + step_s
    turn2 = prior.turn_rate_rad_s**2 * (unseen_s**2 - neighbour.unseen_s**2)
    loose = np.minimum(np.sqrt(spreads**2 + turn2), np.pi)
    turned, sharp = quats, loose
    measured, jump = False, _JUMP
    if motion is not None and motion.R_prev_next is not None:
        measured, jump = True, _FOLLOWED_JUMP
        rotation = trusted_rotation(motion.R_prev_next)
        along = rotation.inv() if back else rotation
        turned = (Rotation.from_quat(quats, scalar_first=True) * along).as_quat(scalar_first=True)
        sharp = np.minimum(np.hypot(spreads, rotation_sigma(motion)), np.pi)
    # variance per axis of a ball that is filled evenly
    reach2 = max(prior.reach_m(unseen_s) ** 2 - prior.reach_m(neighbour.unseen_s) ** 2, 0.0) / 5
    position_spreads = np.sqrt(hypotheses.position_spreads**2 + reach2)
    # a hypothesis that is vaguer than the volume says no more than elsewhere does
    widths = np.log(position_spreads).sum(axis=1) + 3 * np.log(sharp) + 3 * np.log(2 * np.pi)
    log_weights = hypotheses.log_weights + np.minimum(np.log(prior.volume_m3 * _ROTATIONS) - widths, 0)
    ahead = PoseMixture.weighted(hypotheses.positions_xyz, position_spreads, turned, sharp, log_weights)
    elsewhere = 1 - (1 - jump) * (1 - neighbour.elsewhere) * float(np.exp(log_weights).sum())
    elsewhere = min(max(elsewhere, jump), 1 - _MIN_MASS)
    return Prediction(ahead, quats, loose, measured, elsewhere, unseen_s)


def update(
    ahead: Prediction, evidence: PoseMixture, prior: MotionPrior, *, wrong: float, tempering: float
) -> Posterior:
    """The posterior of a frame: prediction times evidence, hypotheses of the image or of another independent source.

    Of each pair, a predicted hypothesis and one of the image, the product is merged with all others that have the same
    sharper member. `wrong` is the probability that the evidence says nothing of the pose, `tempering` the power to
    which masses of the evidence's places are raised, see :func:`tempered`, and with a factor normalisers; distances
    count in full.
    """
    predicted = ahead.hypotheses
    observed = tempered(evidence, tempering, prior)
    ahead_v, image_v = predicted.position_spreads**2, observed.position_spreads**2
    ahead_a, image_a = predicted.orientation_spreads_rad**2, observed.orientation_spreads_rad**2
    step = observed.positions_xyz[None] - predicted.positions_xyz[:, None]
    total_v, pair_a = ahead_v[:, None] + image_v[None], np.repeat(ahead_a[:, None], len(image_a), axis=1)
    turn = _rotation_vectors(predicted.orientations_quat_wxyz, observed.orientations_quat_wxyz)
    # densities relative to an even spread over the volume and all rotations
    normaliser = tempering * _SHARPNESS
    position = _log_density((step**2 / total_v).sum(axis=2), np.log(total_v).sum(axis=2), normaliser)
    rotation = _log_density((turn**2).sum(axis=2) / (pair_a + image_a), 3 * np.log(pair_a + image_a), normaliser)
    volume, image_volume = (np.log(v).sum(axis=1) + 3 * np.log(a) for v, a in ((ahead_v, ahead_a), (image_v, image_a)))
    image_is_sharper = image_volume[None] <= volume[:, None]
    if ahead.measured:
        loose = np.repeat(ahead.unturned_spreads_rad[:, None] ** 2, len(image_a), axis=1)
        apart = _rotation_vectors(ahead.unturned_quats_wxyz, observed.orientations_quat_wxyz)
        unturned = _log_density((apart**2).sum(axis=2) / (loose + image_a), 3 * np.log(loose + image_a), normaliser)
        unturned += np.log(_ROTATION_OUTLIER)
        outlier = unturned > rotation
        rotation = np.logaddexp(rotation, unturned)
        turn, pair_a = np.where(outlier[..., None], apart, turn), np.where(outlier, loose, pair_a)
        image_is_sharper = image_is_sharper | outlier  # the predicted ones are turned
    anywhere = normaliser * np.log(prior.volume_m3 * _ROTATIONS)
    pairs = predicted.log_weights[:, None] + observed.log_weights[None] + position + rotation + anywhere
    pairs += np.log1p(-wrong) + np.log1p(-ahead.elsewhere)
    alone = predicted.log_weights + np.log(wrong) + np.log1p(-ahead.elsewhere)
    fresh = observed.log_weights + np.log(ahead.elsewhere) + np.log1p(-wrong)
    top = max(pairs.max(), alone.max(), fresh.max())
    mass = np.exp(pairs - top)
    share, share_a = ahead_v[:, None] / total_v, (pair_a / (pair_a + image_a))[..., None]
    # the errors of consecutive images are partly the same, so that two are no more precise than the better one
    between_v, between_a = np.minimum(ahead_v[:, None], image_v[None]), np.minimum(pair_a, image_a[None])
    by_image = _merged(
        observed,
        np.exp(fresh - top),
        np.where(image_is_sharper, mass, 0).T,
        np.swapaxes((share - 1) * step, 0, 1),
        np.swapaxes(between_v, 0, 1),
        np.swapaxes((share_a - 1) * turn, 0, 1),
        between_a.T,
    )
    of_predicted = np.where(image_is_sharper, 0, mass)
    by_predicted = _merged(
        predicted, np.exp(alone - top), of_predicted, share * step, between_v, share_a * turn, between_a
    )
    parts = [part for part in (by_image, by_predicted) if part is not None]
    joined, total = pool(parts), np.logaddexp.reduce([part.log_weight for part in parts])
    nowhere = np.log(ahead.elsewhere) + np.log(wrong) - top
    order = np.argsort(-joined.log_weights, kind="stable")
    # many hypotheses of one place must not crowd out what the next images may speak for
    stays = (np.arange(len(order)) < MAX_HYPOTHESES) | (order < _FROM_IMAGE)
    kept = joined.part(order[stays & (joined.log_weights[order] >= np.log(_MIN_MASS))])
    elsewhere = float(np.exp(nowhere - np.logaddexp(total, nowhere)))
    return Posterior(kept, min(max(elsewhere, _MIN_MASS), 1 - _MIN_MASS))


def tempered(evidence: PoseMixture, power: float, prior: MotionPrior) -> PoseMixture:
    """Hypotheses with the probabilities of their places raised to a power.

    Raising the hypotheses one by one would favour places that have many: 50 of mass 0.0004 would weigh as much as one
    of 0.98. What counts is the mass around each, by a kernel as wide as a place.
    """
    if power == 1:
        return evidence
    off2 = ((evidence.positions_xyz[:, None] - evidence.positions_xyz[None]) ** 2).sum(axis=2) / prior.place_m**2
    turns = 2 * np.arccos(np.minimum(np.abs(evidence.orientations_quat_wxyz @ evidence.orientations_quat_wxyz.T), 1))
    around = np.exp(-0.5 * (off2 + (turns / PLACE_RAD) ** 2)) @ evidence.weights
    around = np.maximum(around, np.finfo(float).tiny)  # of a hypothesis that hardly counts
    return evidence.reweighted(evidence.log_weights + (power - 1) * np.log(around))


def new_share(step_s: float) -> float:
    """Share of an image's evidence that the image so many seconds before has not told, see :func:`tempered`."""
    return 1 - ALIKE * float(np.exp(-step_s / _ALIKE_S))


def start(evidence: PoseMixture, *, known: bool) -> Posterior:
    """The posterior of a frame from its image alone, which shows a known place or does not."""
    hypotheses = replace(evidence, measured=np.ones(len(evidence), dtype=np.bool_))  # as those of later frames
    return Posterior(hypotheses, _WRONG if known else _WRONG_IF_UNKNOWN)


def _log_density(distance2: FloatArray, log_determinant: FloatArray, normaliser: float) -> FloatArray:
    """Logarithm of a normal density in three dimensions, its normaliser raised to a power."""
    return np.asarray(-0.5 * (distance2 + normaliser * (log_determinant + 3 * np.log(2 * np.pi))))


def _merged(
    anchors: PoseMixture,
    alone: FloatArray,
    mass: FloatArray,
    offsets: FloatArray,
    variances: FloatArray,
    turns: FloatArray,
    angle_variances: FloatArray,
) -> Share | None:
    """Each of m anchors with k products around it, by their first two moments; None if all of them are impossible.

    `alone` (m,) is the mass of each anchor by itself, `mass` (m, k) that of its products; positions and rotation
    vectors of these, (m, k, 3), are relative to the anchor.
    """
    total = mass.sum(axis=1) + alone
    kept = total > 0
    if not kept.any():
        return None
    anchors, total, alone = anchors.part(kept), total[kept], alone[kept]
    share, alone_share = mass[kept] / total[:, None], alone / total
    offsets, variances, turns, angles = offsets[kept], variances[kept], turns[kept], angle_variances[kept]
    mean, turn = np.einsum("mk,mki->mi", share, offsets), np.einsum("mk,mki->mi", share, turns)
    variance = np.einsum("mk,mki->mi", share, variances + (offsets - mean[:, None]) ** 2)
    variance += alone_share[:, None] * (anchors.position_spreads**2 + mean**2)
    angle = np.einsum("mk,mk->m", share, angles + ((turns - turn[:, None]) ** 2).sum(axis=2) / 3)
    angle += alone_share * (anchors.orientation_spreads_rad**2 + (turn**2).sum(axis=1) / 3)
    quats = Rotation.from_quat(anchors.orientations_quat_wxyz, scalar_first=True) * Rotation.from_rotvec(turn)
    log_weights = np.log(total)
    mixture = PoseMixture.weighted(
        anchors.positions_xyz + mean,
        np.sqrt(variance),
        quats.as_quat(scalar_first=True),
        np.minimum(np.sqrt(angle), np.pi),
        log_weights,
    )
    return Share(mixture, float(np.logaddexp.reduce(log_weights)))


def _rotation_vectors(start: FloatArray, end: FloatArray) -> FloatArray:
    """(m, k, 3) rotation vectors from each of m quaternions to each of k, wxyz, in the frame of the first.

    For 48 by 48 pairs this takes a tenth of the time of SciPy's Rotation, and a filter step calls it twice.
    """
    w0, x0, y0, z0 = (start * _CONJUGATE).T[..., None]
    w1, x1, y1, z1 = end.T[:, None]
    w = w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1
    v = np.stack(
        (
            w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
            w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
            w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
        ),
        axis=2,
    )
    sine = np.linalg.norm(v, axis=2)
    angle = 2 * np.arctan2(sine, np.abs(w))
    factor = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 2.0) * np.where(w < 0, -1, 1)
    return np.asarray(v * factor[..., None])


class _Step(NamedTuple):
    evidence: PoseMixture
    known: bool
    motion: RelativeMotion | None
    timestamp_s: float
    posterior: Posterior


class Window(NamedTuple):
    """The last frames of a stream."""

    seen: Observations  # what is known of each
    forward: Sequence[Posterior]  # the posterior of each from the frames up to it


class PoseFilter:
    """Posteriors of a stream: each from the frames so far, and in hindsight those of the last frames."""

    def __init__(self, prior: MotionPrior, lag: int = LAG) -> None:
        """From the speeds and turning rates to expect; :meth:`window` holds `lag` frames before the newest."""
        self.prior = prior
        self._steps: deque[_Step] = deque(maxlen=lag + 1)

    def reset(self) -> None:
        """Start a new recording."""
        self._steps.clear()

    def push(
        self, evidence: PoseMixture, motion: RelativeMotion | None, timestamp_s: float, *, known: bool = True
    ) -> Posterior:
        """The posterior of the next frame, from the hypotheses of its image and the motion from the frame before.

        Where the image does not show a `known` place, its hypotheses count less.
        """
        if not self._steps:
            posterior = start(evidence, known=known)
        else:
            before = self._steps[-1]
            step_s = timestamp_s - before.timestamp_s
            ahead = predict(before.posterior, motion, step_s, self.prior)
            posterior = weigh(ahead, evidence, self.prior, known=known, share=new_share(step_s))
        self._steps.append(_Step(evidence, known, motion, timestamp_s, posterior))
        return posterior

    def window(self) -> Window:
        """The last frames, at most `lag` before the newest; they stay the same when others are pushed."""
        evidence, known, motions, times, posteriors = zip(*self._steps, strict=True)
        return Window(Observations(evidence, motions, np.array(times), known=np.array(known)), posteriors)


def weigh(ahead: Prediction, evidence: PoseMixture, prior: MotionPrior, *, known: bool, share: float) -> Posterior:
    """The posterior of a frame from its prediction and its image, which shows a known place or does not.

    `share` is that of the image's evidence that others have not told.
    """
    wrong = _WRONG if known else _WRONG_IF_UNKNOWN
    posterior = update(ahead, evidence, prior, wrong=wrong, tempering=share)
    return replace(posterior, unseen_s=0.0 if known else ahead.unseen_s)


def filter_posteriors(seen: Observations, prior: MotionPrior) -> list[Posterior]:
    """The posterior of each frame of a recording, from the frames up to it."""
    pose_filter = PoseFilter(prior, lag=0)
    frames = zip(seen.candidates, seen.motions, seen.timestamps_s.tolist(), seen.is_known.tolist(), strict=True)
    return [pose_filter.push(c, motion, t, known=known) for c, motion, t, known in frames]


def hindsight_posteriors(
    seen: Observations, prior: MotionPrior, forward: Sequence[Posterior] | None = None
) -> list[Posterior]:
    """The posterior of each frame of a recording, from all of its frames: forward, times what later frames predict.

    `forward` is what :func:`filter_posteriors` gave, if it ran already.
    """
    posteriors = list(filter_posteriors(seen, prior) if forward is None else forward)
    # Each image tells the share that the image before it has not, as on the way forward, so that each counts once.
    steps_s = np.diff(seen.timestamps_s).tolist()
    last = tempered(seen.candidates[-1], new_share(steps_s[-1]), prior) if steps_s else seen.candidates[-1]
    later = start(last, known=bool(seen.is_known[-1]))  # from this frame on
    for t in range(len(seen.candidates) - 2, -1, -1):
        ahead = predict(later, seen.motions[t + 1], steps_s[t], prior, back=True)
        posteriors[t] = _joined(posteriors[t], ahead, prior)
        if t > 0:
            share = new_share(steps_s[t - 1])
            later = weigh(ahead, seen.candidates[t], prior, known=bool(seen.is_known[t]), share=share)
    return posteriors


def _joined(forward: Posterior, ahead: Prediction, prior: MotionPrior) -> Posterior:
    """A posterior from the frames up to this one, times what later frames predict."""
    joined = update(ahead, forward.hypotheses, prior, wrong=forward.elsewhere, tempering=1.0)
    unseen_s = [side.unseen_s for side in (forward, ahead) if side.elsewhere <= 0.5]  # from a side that is not lost
    return replace(joined, unseen_s=min(unseen_s, default=np.inf))
