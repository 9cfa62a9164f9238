"""The estimator: from frames to regions, places and a trajectory, and the choice of a method's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from conformodal.core.arrays import Float32Array, FloatArray, UInt8Array
from conformodal.features.local import LocalFeatures, local_feature_parts
from conformodal.geometry import Pose, RelativeMotion, Trajectory, pose_targets
from conformodal.geometry.camera import NO_FLOW
from conformodal.io.decoding import grey_image
from conformodal.localizer.carrying import CarrySettings, FeatureStream, FrameLook, StreamFrame
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.filter import PoseFilter, Window, hindsight_posteriors
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.observations import MotionPrior, choose_places, find_places
from conformodal.localizer.regions import EvidenceType, PoseRegions
from conformodal.tracking.tracker import ImageCorners, MotionFrontEnd, affine_flow

from .config import Method, OdometryError
from .estimates import Estimate
from .model import METHODS, ONLINE, RELIABLE, Localization, PoseModel
from .odometry import InputWatch, Odometry
from .paper import PaperOdometry
from .store import load_model
from .stream import as_trajectory

_ROUNDING = 1e-9  # of p-values, relative


class VisualOdometry(Odometry):
    """Poses of one camera, frame by frame (:meth:`step`) or for a whole recording (:meth:`process`).

    ``examples/stream.py`` answers a camera or a video frame by frame, ``examples/images.py`` a whole data set.
    :attr:`Estimate.revised` goes back ten frames of a stream; :meth:`process` uses all.
    """

    answer = METHODS[0]
    whole_paths = True

    def __init__(self, model: PoseModel) -> None:
        if model.method is Method.PAPER:
            raise OdometryError("the model was trained with the paper's method; PaperOdometry runs it")
        self.model = model
        self._filter = PoseFilter(model.prior)
        self.reset()

    @classmethod
    def load(cls, folder: Path | str) -> Self:
        """Load a saved model; a ModelFileError says if it is missing, damaged or altered."""
        return cls(load_model(folder))

    def reset(self) -> None:
        """Forget the stream so far."""
        self._front_end = MotionFrontEnd(self.model.camera)
        self._watch = InputWatch(self.model.expected_input)
        self._filter.reset()
        model = self.model
        # where training frames are further apart, no carried corners are calibrated
        settings = CarrySettings()
        self._stream = FeatureStream(
            model.localizer,
            model.camera,
            model.detector,
            follows=model.follows_streams,
            carries=model.expected_input.step_s <= settings.max_step_s,
            quality=model.quality,
            settings=settings,
        )
        self._last_s = self._usable_s = None

    def start_near(self, pose: PoseMixture, timestamp_s: float) -> None:
        """Begin the path anew from a pose that is known from elsewhere, at a time before that of the next frame.

        The next images choose among their hypotheses by it, and overrule it where they agree on another one. Regions
        of single images do not depend on it; those from all frames so far were calibrated without it.
        """
        self._filter.reset()
        self._filter.push(pose, None, timestamp_s)

    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        grey = grey_image(image)  # once for tracker and local features
        motion = self._motion(grey, self._stream.corners_to_follow(timestamp_s))
        evidence = FrameEvidence(partial(self._features, image))
        carried = False
        if self.model.looks_at_local_features:
            look = self._look(grey, timestamp_s, motion)
            evidence = replace(evidence, local_features=[look.features], estimates=[look.estimates], busy=look.busy)
            carried = look.carried
        localization = self.model.localize(evidence)
        self._stream.observe(localization.beliefs.estimates[0])
        return replace(self._estimate(localization, motion, timestamp_s), carried=carried)

    def _look(self, grey: UInt8Array, timestamp_s: float, motion: RelativeMotion | None) -> FrameLook:
        """The local features of the next frame."""
        flow = self._flow(timestamp_s)
        detect = partial(self._detect, grey, flow)
        followed = self._front_end.tracker.beside
        return self._stream.look(StreamFrame(grey, timestamp_s, motion, flow, followed), detect)

    # ---- what is measured in an image; a recording that was looked at before has it already

    def _motion(self, grey: UInt8Array, beside: ImageCorners | None) -> RelativeMotion | None:
        return self._front_end.measure(grey, beside)

    def _features(self, image: UInt8Array) -> Float32Array:
        return self.model.backbone.features_of(image)

    def _flow(self, timestamp_s: float) -> FloatArray:
        if self._usable_s is None:
            return NO_FLOW
        return affine_flow(self._front_end.tracker.step, timestamp_s - self._usable_s, self.model.camera)

    def _detect(self, grey: UInt8Array, flow: FloatArray, turn_rad: float) -> Iterator[LocalFeatures | None]:
        for features in local_feature_parts(grey, self.model.camera, self.model.detector, turn_rad):
            yield None if features is None else features._replace(flow=flow)

    def _estimate(self, localization: Localization, motion: RelativeMotion | None, timestamp_s: float) -> Estimate:
        """The estimate of the next frame, from the posterior up to it."""
        candidates, shows_known = localization.candidates[0], bool(localization.known[0])
        posterior = self._filter.push(candidates, motion, timestamp_s, known=shows_known)
        places = find_places(posterior, self.model.prior)
        best = places[0]
        evidence, known_p = EvidenceType(int(localization.kinds[0])), float(localization.known_p[0])
        problems = [] if motion is None or motion.reliable else [str(motion.status)]
        if evidence is EvidenceType.UNKNOWN:
            problems.append(f"like no place that is known (p = {known_p:.2g})")
        elif known_p <= self._least_p:
            problems.append(f"recognised more weakly than every frame that calibrates (p = {known_p:.2g})")
        if best.probability < RELIABLE:
            problems.append(f"the most probable place has p = {best.probability:.2g}")
        path_region = self.model.path_regions(localization, [posterior], ONLINE)
        problems += self._doubts(localization.regions if path_region is None else path_region, best)
        if path_region is not None and not self._holds(localization.regions, best):  # a path may be sure and wrong
            problems.append("the pose lies outside of the image's region")
        return Estimate(
            timestamp_s=timestamp_s,
            pose=best,
            region=localization.regions,
            path_region=path_region,
            candidates=candidates,
            relative_motion=motion,
            reliable=not problems,
            problem="; ".join(problems),
            localization=localization,
            estimates=list(localization.beliefs.estimates[0]),
            known_p=None if np.isnan(known_p) else known_p,
            evidence=evidence,
            position_spread_m=float(np.linalg.norm(best.position_spreads)),
            orientation_spread_rad=best.orientation_spread_rad,
            variance_factor=self.model.variance_factor(localization, posterior),
            posterior=posterior,
            places=places,
            tracks=self._front_end.tracks,
            corners=self._front_end.corners,
            revise=partial(_revised, self._filter.window(), self.model.prior),
        )

    @property
    def _least_p(self) -> float:
        """The p-value of an image that is recognised more weakly than every frame that calibrates."""
        novelty = self.model.novelty
        least = 0.0 if novelty is None else (novelty.matched or novelty.test).least_p
        return min(self.model.rules.level, (1 + _ROUNDING) * least)

    def _doubts(self, region: PoseRegions, pose: Pose) -> list[str]:
        """Why a calibrated region does not vouch for a pose."""
        if region.unbounded.any():
            return ["the region is unbounded"]
        if region.n_places[0] > 1:
            return [f"the region names {region.n_places[0]} places"]
        return [] if self._holds(region, pose) else ["the pose lies outside of its region"]

    def _holds(self, region: PoseRegions, pose: Pose) -> bool:
        """Whether a region contains a pose."""
        return bool(region.contains(pose_targets(pose.at(0.0), self.model.sign_reference), joint=True)[0])


def _revised(window: Window, prior: MotionPrior) -> Trajectory:
    """The poses of the last frames of a stream, in hindsight."""
    posteriors = hindsight_posteriors(window.seen, prior, window.forward)
    return as_trajectory(choose_places(posteriors, window.seen.timestamps_s, prior))


def odometry_of(model: PoseModel) -> Odometry:
    """The system that runs a model, by the model's method."""
    return PaperOdometry(model) if model.method is Method.PAPER else VisualOdometry(model)
