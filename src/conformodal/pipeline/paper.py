"""The paper's system: a network with softmaxes, their calibration, and greedy reasoning over intervals and motion.

Greedy reasoning (section 3) starts from the most probable pose, then always takes the combination of intervals that is
nearest to what the relative motion predicts from the pose chosen before. One wrong pick steers all later ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.conformal import SplitConformal
from conformodal.core.arrays import Float32Array, FloatArray, UInt8Array
from conformodal.geometry import RelativeMotion
from conformodal.localizer.evidence import FrameEvidence
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.modes import BinRuns, interval_mixtures, interval_runs
from conformodal.localizer.observations import UncertainPose, fit_motion_prior
from conformodal.localizer.regions import EvidenceType, RegionRules, Support, pose_regions
from conformodal.localizer.training_data import TrainingData
from conformodal.tracking.tracker import EssentialFrontEnd

from .calibrate import check_unseen
from .config import Method, ModelConfig, OdometryError
from .estimates import Estimate
from .folds import make_folds, settings_record
from .identity import identify
from .model import PAPERS_METHOD, ExpectedInput, Localization, PoseModel
from .odometry import InputWatch, Odometry

_MIN_NORM = 1e-6


def train_paper(data: TrainingData, config: ModelConfig) -> PoseModel:
    """Train and calibrate the paper's system (section 2): one evidence type, no novelty test, no regions of paths.

    Each target is calibrated at alpha by itself, on the sets of bins that its softmax gives.
    """
    folds = make_folds(data.sequence, data.split, config.calibrate_on, config.alpha)
    [fold] = folds.folds
    [localizer] = Localizer.fit_each(data, [fold.train], config.sources)
    check_unseen(localizer, fold.held_out)
    proba = localizer.beliefs(FrameEvidence(data.features[fold.held_out])).proba
    rule = SplitConformal(localizer.bins, config.alpha, config.score, config.joint)
    rule.calibrate(proba, data.targets[fold.held_out])
    train = data.split.train
    return PoseModel(
        backbone=data.require_backbone(),
        localizer=localizer,
        novelty=None,
        rules=RegionRules(rule, None, np.ones(len(fold.held_out)), 0.0),
        prior=fit_motion_prior(data.sequence.require_truth()[train], data.sequence.recording[train]),
        camera=data.sequence.camera,
        split=data.split,
        known_frames=identify(data.sequence),
        expected_input=ExpectedInput.of(data.sequence),
        configuration=settings_record(config, data.sequence, folds),
        detector=data.detector,
    )


class PaperOdometry(Odometry):
    """The paper's system, as it stands: a network with softmaxes, their calibration, and greedy reasoning.

    Its model was trained with :meth:`ModelConfig.paper`; its estimates have the form of those of
    :class:`VisualOdometry`.
    """

    answer = PAPERS_METHOD
    whole_paths = False  # what a stream is told is final

    def __init__(self, model: PoseModel) -> None:
        if model.method is not Method.PAPER:
            raise OdometryError("the model was not trained with the paper's method; VisualOdometry runs it")
        self.model = model
        self.reset()

    def reset(self) -> None:
        """Forget the stream so far."""
        self._front_end = EssentialFrontEnd(self.model.camera)
        self._watch = InputWatch(self.model.expected_input)
        self._path = Greedy()
        self._last_s = self._usable_s = None

    def _answer(self, image: UInt8Array, timestamp_s: float) -> Estimate:
        localization = self._localize(self.model.backbone.features_of(image))
        proba, region = localization.beliefs.proba, localization.regions
        motion = self._front_end.measure(image)
        pose = self._path.push(interval_runs(proba, region)[0], motion)
        reliable = motion is None or motion.reliable
        return Estimate(
            timestamp_s=timestamp_s,
            pose=pose,
            region=region,
            candidates=interval_mixtures(proba, region)[0],
            relative_motion=motion,
            reliable=reliable,
            problem="" if reliable or motion is None else str(motion.status),
            localization=localization,
            tracks=self._front_end.tracks,
            corners=self._front_end.corners,
            evidence=EvidenceType.GLOBAL,
            position_spread_m=float(np.linalg.norm(pose.position_spreads)),
            orientation_spread_rad=pose.orientation_spread_rad,
        )

    def _localize(self, features: Float32Array) -> Localization:
        """The region of an image as the paper has it: sets of bins, whatever the image."""
        beliefs, rule = self.model.localizer.beliefs(FrameEvidence(features)), self.model.calibration
        supports = [Support.of(mixture, rule.bins, self.model.sign_reference) for mixture in beliefs.mixtures]
        regions = pose_regions(rule, beliefs.proba, supports, rule.thresholds_)
        kinds, rooms = np.array([EvidenceType.GLOBAL], dtype=np.int64), np.zeros(1, dtype=np.int64)
        return Localization(beliefs, regions, np.array([np.nan]), kinds, rooms)


class Greedy:
    """The paper's reasoning on a stream: :meth:`push` chooses one of all combinations of intervals per frame.

    Orientation: the q that minimises ``|q - q_next|`` with ``q_next = quaternion(R_prev R_rel)``; q and -q count as
    one. The square of that distance is a sum over components, so each is minimised by itself. Position: the p that
    minimises ``| t_rel - (p - p_prev) / |p - p_prev| |`` with t_rel turned into the world by the orientation chosen
    before. In the first frame, and where the rotation is unknown, the most probable combination is taken; where the
    direction alone is unknown, the most probable position.
    """

    def __init__(self) -> None:
        self._place: FloatArray | None = None
        self._quat: FloatArray = np.array([1.0, 0.0, 0.0, 0.0])

    def push(self, here: Sequence[BinRuns], motion: RelativeMotion | None) -> UncertainPose:
        """The pose of the next frame, from its :func:`~conformodal.localizer.modes.interval_runs`.

        `motion` leads from the frame before to it; None where nothing is known of it.
        """
        best = [int(np.argmax(runs.log_mass)) for runs in here]
        means = [runs.mean for runs in here]
        if self._place is not None and motion is not None and motion.R_prev_next is not None:
            rotation_prev = Rotation.from_quat(self._quat, scalar_first=True)
            q_next = (rotation_prev * Rotation.from_matrix(motion.R_prev_next)).as_quat(scalar_first=True)
            best[3:] = _nearest_quat(means[3:], q_next)
            if motion.direction_prev is not None:
                best[:3] = _along(means[:3], self._place, rotation_prev.apply(motion.direction_prev))
        chosen = np.array([mean[k] for mean, k in zip(means, best, strict=True)])
        spreads = np.array([runs.spread[k] for runs, k in zip(here, best, strict=True)])
        self._place = chosen[:3]
        norm = float(np.linalg.norm(chosen[3:]))
        if norm > _MIN_NORM:  # components that cancel say nothing
            self._quat = chosen[3:] / norm
        turn = 2 * np.sqrt(np.mean(spreads[3:] ** 2))  # a quaternion moves half as far as the rotation turns
        return UncertainPose(self._place, self._quat, spreads[:3], float(turn))


def _nearest_quat(means: Sequence[FloatArray], q_next: FloatArray) -> list[int]:
    """The combination nearest to `q_next` or to its negative."""
    options = []
    for target in (q_next, -q_next):
        off = [np.abs(mean - q) for mean, q in zip(means, target, strict=True)]
        options.append((sum(float(o.min()) ** 2 for o in off), [int(o.argmin()) for o in off]))
    return min(options, key=lambda option: option[0])[1]


def _along(means: Sequence[FloatArray], place: FloatArray, direction: FloatArray) -> list[int]:
    """The combination that lies from `place` most nearly in a direction."""
    step = np.stack(np.meshgrid(*means, indexing="ij"), axis=-1) - place
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    heading = np.divide(step, length, out=np.zeros_like(step), where=length > 0)
    off = np.linalg.norm(direction - heading, axis=-1)
    return [int(k) for k in np.unravel_index(int(np.argmin(off)), off.shape)]
