"""The paper's system, as it stands: a network with softmaxes, their calibration, and greedy reasoning."""

from __future__ import annotations

import numpy as np

from conformodal.core.arrays import Float32Array, UInt8Array
from conformodal.localizer.candidates import interval_candidates, interval_runs
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.greedy import Greedy
from conformodal.localizer.regions import EvidenceType, Support, pose_regions
from conformodal.tracking.tracker import EssentialFrontEnd

from .config import Method
from .errors import OdometryError
from .estimates import Estimate
from .estimator import Odometry, VisualOdometry
from .model import PAPERS_METHOD, Localization, PoseModel
from .stream import as_trajectory


class PaperOdometry(Odometry):
    """The paper's system on a stream or a recording; its estimates have the form of those of :class:`VisualOdometry`.

    Parameters
    ----------
    model
        Trained with :meth:`ModelConfig.paper`.

    Raises
    ------
    OdometryError
        If the model is another.
    """

    answer = PAPERS_METHOD
    lag = 0
    whole_paths = False  # what a stream is told is final

    def __init__(self, model: PoseModel) -> None:
        if model.method is not Method.PAPER:
            raise OdometryError("the model was not trained with the paper's method; VisualOdometry runs it")
        self.model = model
        self.reset()

    def reset(self) -> None:
        """Forget the stream so far."""
        self._front_end = EssentialFrontEnd(self.model.camera)
        self._path = Greedy()
        self._last_s = self._usable_s = None

    def _fresh(self) -> PaperOdometry:
        return PaperOdometry(self.model)

    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        localization = _localize(self.model, self.model.backbone.features_of(image))
        proba, region = localization.beliefs.proba, localization.regions
        motion = self._front_end.measure(image)
        path = self._path.push(interval_runs(proba, region)[0], motion, timestamp_s)
        reliable = motion is None or motion.reliable
        return Estimate(
            timestamp_s=timestamp_s,
            pose=as_trajectory(path),
            region=region,
            candidates=interval_candidates(proba, region)[0],
            relative_motion=motion,
            reliable=reliable,
            problem="" if reliable or motion is None else str(motion.status),
            localization=localization,
            tracks=self._front_end.tracks,
            corners=self._front_end.corners,
            evidence=EvidenceType.GLOBAL,
            position_spread_m=float(np.linalg.norm(path.position_spreads[0])),
            orientation_spread_rad=float(path.orientation_spreads_rad[0]),
        )


def _localize(model: PoseModel, features: Float32Array) -> Localization:
    """Regions of n images as the paper has them: sets of bins, whatever the image."""
    beliefs = model.localizer.beliefs(FrameEvidence(features))
    n = len(features)
    kinds, rule = np.full(n, EvidenceType.GLOBAL, dtype=np.int64), model.calibration
    supports = [Support.of(m.candidates, rule.bins, model.sign_reference) for m in beliefs.mixtures]
    regions = pose_regions(rule, beliefs.proba, supports, rule.thresholds_)
    return Localization(beliefs, regions, np.full(n, np.nan), kinds)


def odometry_of(model: PoseModel) -> Odometry:
    """The system that runs a model, by the model's method."""
    return PaperOdometry(model) if model.method is Method.PAPER else VisualOdometry(model)
