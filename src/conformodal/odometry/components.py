"""How many principal components of the features to learn from, chosen on training frames alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins
from conformodal.datasets import SplitKind, hold_out
from conformodal.vision import TrainingConfig, fit_head, predict_proba, soft_cross_entropy

HELD_OUT = 0.25


def choose_components(
    features: npt.NDArray[np.float32],
    targets: npt.NDArray[np.float64],
    recording: npt.NDArray[np.int64],
    frames: npt.NDArray[np.int64],
    choices: Sequence[int | None],
    *,
    kind: SplitKind,
    bins: QuantileBins,
    sigma_bins: float,
    training: TrainingConfig,
    progress: Callable[[int, int], None] | None = None,
) -> int | None:
    """The choice under which frames that were held out from training are most probable.

    Few components say less of chance details, which pays far from the training frames; many say more, which pays
    close to them. Frames are held out in the way in which the test part is. The calibration part is not looked at, so
    calibration stays exchangeable with new frames.

    Parameters
    ----------
    features, targets, recording
        (n, F), (n, d) and (n,) of all frames.
    frames
        Those of the training part.
    choices
        Numbers of components; if there is only one, nothing is trained.
    kind
        How to hold out.
    bins
        Of all training frames.
    sigma_bins, training
        As for the final head.
    progress
        Called with trainings done and trainings in all.
    """
    if len(choices) == 1:
        return choices[0]
    kept, held = hold_out(frames, recording, kind, HELD_OUT, seed=training.seed)
    labels = np.concatenate(bins.soft_targets(targets[kept], sigma_bins), axis=1)
    scores = []
    for done, k in enumerate(choices):
        if progress is not None:
            progress(done, len(choices))
        settings = replace(training, components=k)
        head = fit_head(features[kept], labels, bins.sizes, soft_cross_entropy, settings)
        proba = predict_proba(head, features[held])
        at = bins.encode(targets[held]).T
        scores.append(np.mean([np.log(p[np.arange(len(a)), a] + 1e-12) for p, a in zip(proba, at, strict=True)]))
    if progress is not None:
        progress(len(choices), len(choices))
    return choices[int(np.argmax(scores))]
