"""Bridging frames that show no known place: candidates are predicted from a neighbour in time by relative motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from conformodal.poses import RelativeMotion

from .candidates import Candidates
from .prior import MotionPrior, rotation_sigma
from .settings import SEARCH


def predict_candidates(
    neighbour: Candidates, motion: RelativeMotion | None, step_s: float, prior: MotionPrior, *, back: bool = False
) -> Candidates:
    """Where the camera can be a time step after a frame, or before it: the prediction of a Bayes filter.

    Orientations follow the relative rotation, positions stay. Spreads grow by what the camera can have moved and
    turned in the time. All candidates are equally probable, so that nothing is counted twice.

    Parameters
    ----------
    neighbour
        Candidates of the frame.
    motion
        From the earlier frame to the later one; None where nothing is known of it.
    step_s
        Seconds between the two.
    prior
        Speeds and turning rates to expect.
    back
        Whether the neighbour is the later one.
    """
    quats, turned = neighbour.orientations_quat_wxyz, prior.turn_rate_rad_s * step_s
    if motion is not None and motion.R_prev_next is not None:
        rotation = Rotation.from_matrix(motion.R_prev_next)
        along = rotation.inv() if back else rotation
        quats = (Rotation.from_quat(quats, scalar_first=True) * along).as_quat(scalar_first=True)
        turned = rotation_sigma(motion)
    return replace(
        neighbour,
        position_spreads=neighbour.position_spreads + prior.reach_m(step_s) / np.sqrt(3),
        orientations_quat_wxyz=quats,
        orientation_spreads_rad=np.minimum(neighbour.orientation_spreads_rad + turned, np.pi),
        log_mass=np.full(len(quats), -np.log(len(quats))),
    )


def blend(own: Candidates, predicted: Candidates) -> Candidates:
    """The candidates of a frame that is taken for unknown: its own, and those predicted from a neighbour."""
    share = SEARCH.own_share
    joined = Candidates.concatenate((own.normalised(np.log(share)), predicted.normalised(np.log1p(-share))))
    return joined.take(np.argsort(-joined.log_mass, kind="stable"))


def bridge(
    candidates: Sequence[Candidates],
    known: npt.NDArray[np.bool_],
    motions: Sequence[RelativeMotion | None],
    timestamps_s: npt.NDArray[np.float64],
    prior: MotionPrior,
    seen: Callable[[int, Candidates], Candidates] | None = None,
) -> list[Candidates]:
    """Candidates of one recording, with those of a neighbour added where a frame is not known.

    Those before the first known frame are bridged from it, the others from the frame before. If no frame is known, all
    stay as they are.

    Parameters
    ----------
    candidates, motions, timestamps_s
        As in :class:`~conformodal.reasoning.observations.Observations`.
    known
        (n,) whether each frame shows a place that is known.
    prior
        Speeds and turning rates to expect.
    seen
        Gives the candidates of frame t when what else is known of that frame is weighed in; None where nothing is.
    """
    found, steps = list(candidates), np.diff(timestamps_s)
    if not known.any():
        return found
    first = int(np.argmax(known))
    for back, order in ((False, range(first + 1, len(found))), (True, range(first - 1, -1, -1))):
        chain = candidates[first]  # of predictions: what is blended in does not multiply along it
        for t in order:
            if known[t]:
                chain = candidates[t]
                continue
            motion, step_s = (motions[t + 1], steps[t]) if back else (motions[t], steps[t - 1])
            chain = predict_candidates(chain, motion, step_s, prior, back=back)
            chain = chain if seen is None else seen(t, chain)
            found[t] = blend(candidates[t], chain)
    return found
