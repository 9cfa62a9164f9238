"""The softmaxes behind a kept run, with the probability from which a bin is in a set."""

from __future__ import annotations

from collections.abc import Sequence as Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import Regions
from conformodal.datasets import Sequence
from conformodal.localization import FrameEvidence, cells_per_bin
from conformodal.odometry import Method, PoseModel, load_model
from conformodal.vision import FeatureCache, extract_features

from ..errors import ExperimentError
from .bin_runs import MODEL


@dataclass(frozen=True, eq=False)
class Softmaxes:
    """Softmaxes and regions of the n frames of a run.

    Attributes
    ----------
    model
        With the score ``lac``.
    frames
        (n,) indices into the sequence.
    proba
        Seven arrays (n, K_j).
    regions
        Of the n frames.
    least
        (7,) least probability of a bin in a set, 1 - q.
    """

    model: PoseModel
    frames: npt.NDArray[np.int64]
    proba: list[npt.NDArray[np.floating[Any]]]
    regions: Regions
    least: npt.NDArray[np.floating[Any]]

    @classmethod
    def of(cls, place: Path, names: Collection[str], sequence: Sequence, cache: FeatureCache) -> Softmaxes:
        """The softmaxes of a run that :func:`bin_runs` kept.

        Parameters
        ----------
        place
            Its folder.
        names
            Of its frames, in order.
        sequence
            That it answers.
        cache
            Of features.

        Raises
        ------
        ExperimentError
            If the sequence's test frames are not those of the run.
        """
        model = load_model(place / MODEL)
        left = iter(model.split.test.tolist())
        frames = [next((i for i in left if sequence.image_paths[i].name == name), -1) for name in names]
        if -1 in frames:
            raise ExperimentError(f"{place}: its frame {names[frames.index(-1)]} is no test frame of {sequence.name}")
        paths = [sequence.image_paths[i] for i in frames]
        rule, beliefs = (
            model.calibration,
            model.localizer.beliefs(FrameEvidence(extract_features(paths, model.backbone, cache))),
        )
        least, rows = 1 - rule.thresholds_, np.array(frames, dtype=np.int64)
        if model.method is Method.PAPER:
            return cls(model, rows, beliefs.proba, rule.predict(beliefs.proba), least)
        regions = model.regions(beliefs, np.tile(rule.thresholds_, (len(beliefs), 1)))
        return cls(model, rows, beliefs.proba, regions, least * cells_per_bin(model.bins))
