"""The paper's system, as it stands: a network with softmaxes, their calibration, and greedy reasoning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins, SplitConformal
from conformodal.conformal.calibration import as_joint
from conformodal.datasets import Sequence
from conformodal.motion import EssentialFrontEnd
from conformodal.poses import Trajectory
from conformodal.reasoning import (
    Greedy,
    SpreadScale,
    fit_motion_prior,
    greedy,
    interval_candidates,
    interval_means,
    softmax_mean,
)
from conformodal.vision import (
    FeatureCache,
    fit_head,
    predict_proba,
    soft_cross_entropy,
)

from .answers import PAPERS_ANSWER, as_trajectory
from .config import Method, ModelConfig, record_of
from .errors import OdometryError
from .estimates import Estimate, OdometryRun
from .estimator import VisualOdometry
from .frame import as_image, as_time
from .identity import identify
from .landmarks import Fixes
from .model import PoseModel, Search
from .motions import MotionRecord, Progress, measure_motions, stage_of
from .reading import chosen_frames, read_frames
from .region_rules import Evidence, RegionRules
from .training_data import TrainingData

IntArray = npt.NDArray[np.int64]


def train_paper(
    data: TrainingData,
    config: ModelConfig,
    *,
    checkpoint_dir: Path | None = None,
    progress: Progress | None = None,
) -> PoseModel:
    """Train on the training part, calibrate on the calibration part; see :meth:`ModelConfig.paper`."""
    train, held_out = data.split.train, data.split.calibration
    bins = QuantileBins(config.n_bins, config.margin).fit(data.targets[train])
    labels = np.concatenate(bins.soft_targets(data.targets[train], config.sigma_bins), axis=1)
    head = fit_head(
        data.features[train],
        labels,
        bins.sizes,
        soft_cross_entropy,
        config.training,
        projection=data.projection(train, None),
        checkpoint_dir=checkpoint_dir,
        progress=stage_of(progress, "training"),
    )
    calibration = SplitConformal(bins, config.alpha, config.score, as_joint(config.joint))
    calibration.calibrate(predict_proba(head, data.features[held_out]), data.targets[held_out])
    n, truth = len(held_out), data.sequence.require_truth()
    return PoseModel(
        backbone=data.backbone,
        head=head,
        finders=(),
        local=None,
        landmarks=None,
        region_landmarks=None,
        known=None,
        bins=bins,
        rules=RegionRules(calibration, None, np.zeros(n, dtype=bool), np.ones(n), 0.0),
        sign_reference=data.sign_reference,
        prior=fit_motion_prior(truth[train], data.sequence.recording[train]),
        scale=SpreadScale(),
        camera=data.sequence.camera,
        split=data.split,
        known_frames=identify(data.sequence),
        configuration=record_of(config, data.sequence.name, len(data.sequence), "frames"),
    )


class PaperOdometry:
    """The paper's system on a stream or a sequence; what it answers has the form of :class:`VisualOdometry`'s.

    Parameters
    ----------
    model
        Trained with :meth:`ModelConfig.paper`.

    Raises
    ------
    OdometryError
        If the model is another.
    """

    answer = PAPERS_ANSWER
    lag, fix_every = 0, 1
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
        self._last_s: float | None = None

    def step(self, image: npt.ArrayLike | None, timestamp_s: float) -> Estimate:
        """Take the next frame of a stream, as :meth:`VisualOdometry.step` does.

        Raises
        ------
        OdometryError
            If the timestamp is not finite, or not later than the one before; nothing has changed then.
        """
        timestamp_s = as_time(timestamp_s, self._last_s)
        image = as_image(image, self.model.camera)
        if isinstance(image, str):
            return Estimate(timestamp_s, None, None, None, None, None, False, image)
        features = self.model.backbone.describe(self.model.backbone.prepare(image)[None]).astype(np.float32)
        proba = self.model.proba(features)
        region = self.model.regions(proba)
        motion = self._front_end.measure(image)
        path = self._path.push(interval_means(proba, region)[0], motion, timestamp_s)
        self._last_s = timestamp_s
        pose = as_trajectory(path)
        reliable = motion is None or motion.reliable
        return Estimate(
            timestamp_s,
            pose,
            pose,
            region,
            interval_candidates(proba, region)[0],
            motion,
            reliable,
            "" if reliable or motion is None else str(motion.status),
            features[0],
            proba,
            Search(proba, None, [[]]),
            self._front_end.tracks,
            self._front_end.corners,
            evidence=Evidence.SOFTMAX,
            position_spread_m=float(np.linalg.norm(path.position_spreads[0])),
            orientation_spread_rad=float(path.orientation_spreads_rad[0]),
        )

    def pass_by(self, image: npt.ArrayLike) -> None:
        """Show a frame of the stream that wants no answer: corners are followed through it, if it is an image."""
        found = as_image(image, self.model.camera)
        if not isinstance(found, str):
            self._front_end.pass_by(found)

    def run(self, sequence: Sequence) -> Trajectory:
        """The trajectory of a whole sequence; :meth:`process` gives all the rest."""
        return self.process(sequence).trajectory

    def process(
        self,
        sequence: Sequence,
        frames: IntArray | None = None,
        *,
        cache: FeatureCache | None = None,
        motions: MotionRecord | None = None,
        progress: Progress | None = None,
    ) -> OdometryRun:
        """Work out regions and the trajectory of a sequence, see :meth:`VisualOdometry.process`.

        Raises
        ------
        OdometryError
            If no frame can be read, the camera is another one, or `frames` are not increasing indices of frames.
        """
        if motions is None:
            motions = paper_motions(sequence, chosen_frames(self.model, sequence, frames), progress)
        usable, features = read_frames(self.model, sequence, frames, motions, cache, progress)
        proba = self.model.proba(features)
        regions, times = self.model.regions(proba), sequence.timestamps_s[usable]
        intervals, found = interval_means(proba, regions), [motions.motions[i] for i in usable.tolist()]
        mean = softmax_mean(proba, self.model.bins)
        positions, quats = np.empty((usable.size, 3)), np.empty((usable.size, 4))
        for number in np.unique(sequence.recording[usable]):
            at = np.flatnonzero(sequence.recording[usable] == number)
            path = greedy([intervals[t] for t in at], [found[t] for t in at], times[at])
            positions[at], quats[at] = path.positions_xyz, path.orientations_quat_wxyz
        return OdometryRun(
            frames=usable,
            timestamps_s=times,
            regions=regions,
            candidates=interval_candidates(proba, regions),
            motions=found,
            submaps=[],
            fixes=[Fixes() for _ in usable],
            trajectories={
                self.answer: Trajectory(times, positions, quats),
                "softmax_mean": Trajectory(times, mean[:, :3], mean[:, 3:]),
            },
            unreadable=motions.unreadable,
            known_p=np.full(usable.size, np.nan),
            kinds=np.full(usable.size, Evidence.SOFTMAX, dtype=np.int64),
            answer=self.answer,
        )


def paper_motions(sequence: Sequence, frames: IntArray, progress: Progress | None = None) -> MotionRecord:
    """Relative motions of `frames` as the paper has them; see :func:`~conformodal.odometry.measure_motions`."""
    return measure_motions(sequence, frames, progress, front_end=EssentialFrontEnd(sequence.camera), landmarks=False)


def odometry_of(model: PoseModel, fix_every: int = 1) -> VisualOdometry | PaperOdometry:
    """What runs a model, by its method.

    Parameters
    ----------
    model
        Trained and calibrated.
    fix_every
        See :class:`VisualOdometry`; the paper's system has no landmarks to look for.
    """
    return PaperOdometry(model) if model.method is Method.PAPER else VisualOdometry(model, fix_every=fix_every)
