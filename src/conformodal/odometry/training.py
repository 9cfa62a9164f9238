"""Training and calibrating a pose model on a sequence with poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins, SplitConformal
from conformodal.conformal.calibration import as_joint
from conformodal.datasets import Sequence, Split, held_out_together, make_split
from conformodal.poses import sign_reference
from conformodal.reasoning import (
    MotionPrior,
    fit_motion_prior,
    fit_spread_scale,
    fix_cells,
    mode_candidates,
    pool_fixes,
)
from conformodal.vision import (
    Backbone,
    BackboneConfig,
    FeatureCache,
    Head,
    LocalAnswers,
    Projection,
    extract_features,
    feature_views,
    fine_tune,
    fit_head,
    fit_local,
    fit_projection,
    pick_device,
    predict_proba,
    soft_cross_entropy,
)

from .config import ModelConfig
from .identity import identify
from .landmarks import LandmarkRegions
from .local import LocalFinder, make_finder
from .model import PoseModel
from .motions import Progress
from .scene import Scene, learn_scene
from .targets import pose_targets, target_scale

_SEED_STEP = 1000  # between heads that are averaged


@dataclass(frozen=True, eq=False)
class TrainingData:
    """A sequence's features, targets and parts: what the pose model and every baseline share.

    Attributes
    ----------
    features
        (n, F) of all frames.
    targets
        (n, 7), see :func:`~conformodal.odometry.targets.pose_targets`.
    """

    sequence: Sequence
    split: Split
    backbone: Backbone
    features: npt.NDArray[np.float32]
    targets: npt.NDArray[np.float64]
    sign_reference: npt.NDArray[np.float64]
    _projections: dict[tuple[bytes, int | None, bool], Projection] = field(default_factory=dict, init=False, repr=False)

    def projection(self, rows: npt.NDArray[np.int64], components: int | None, *, thumbnail: bool = False) -> Projection:
        """Of some frames' features, fitted once; with or without their thumbnails.

        Parameters
        ----------
        rows
            Frames that it may know.
        components, thumbnail
            See :func:`~conformodal.vision.fit_projection`, and :func:`~conformodal.vision.feature_views`.
        """
        key = (rows.tobytes(), components, thumbnail)
        if key not in self._projections:
            views = feature_views(self.features.shape[1])
            view = views.both if thumbnail else views.network
            self._projections[key] = fit_projection(self.features[rows], components, view)
        return self._projections[key]


def prepare_training_data(
    sequence: Sequence, config: ModelConfig, cache: FeatureCache, progress: Progress | None = None
) -> TrainingData:
    """Cut a sequence into parts and compute the features of all its frames.

    Raises
    ------
    PoseError
        If the sequence has no poses.
    SplitError
        If a part would be empty, or the sequence has not the recordings or lists that the split needs.
    ImageError
        If an image cannot be read; names the file.
    """
    truth = sequence.require_truth()
    split = make_split(
        sequence.recording,
        config.split,
        seed=config.seed,
        test=config.test,
        calibration=config.calibration,
        used=config.used,
        given_test=sequence.given_test,
    )
    backbone = Backbone(BackboneConfig.for_images(sequence.camera.width, sequence.camera.height, config.network))
    reference = sign_reference(truth.orientations_quat_wxyz[split.train])
    targets = pose_targets(truth, reference)
    backbone.to(pick_device(config.device))
    if config.fine_tuning is not None:
        bins = QuantileBins(config.n_bins, config.margin).fit(targets[split.train])
        backbone = fine_tune(
            backbone,
            [sequence.image_paths[i] for i in split.train],
            np.concatenate(bins.soft_targets(targets[split.train], config.sigma_bins), axis=1),
            bins.sizes,
            config.fine_tuning,
            cache,
            _stage(progress, "fine-tuning"),
        )
    stage = _stage(progress, "features")
    features = extract_features(sequence.image_paths, backbone, cache, stage, sequence.noise)
    return TrainingData(sequence, split, backbone, features, targets, reference)


def train_model(
    data: TrainingData,
    config: ModelConfig,
    *,
    scene: Scene | None = None,
    checkpoint_dir: Path | None = None,
    progress: Progress | None = None,
) -> PoseModel:
    """Train on the training part, calibrate on the calibration part; the test part is not touched.

    The finders are trained on both parts: the region must not know the calibration frames, but the search for the pose,
    of which nothing is promised, may, as a plain regressor would. So does the scene, which is learnt from both as well
    unless it is given.
    """
    if scene is None:
        scene = learn_scene(data.sequence, data.split, landmarks=config.landmarks, progress=progress)
    train, held_out = data.split.train, data.split.calibration
    everything = np.sort(np.concatenate((train, held_out)))
    bins = QuantileBins(config.n_bins, config.margin).fit(data.targets[train])
    calibration = SplitConformal(bins, config.alpha, config.score, as_joint(config.joint))

    def fit(rows: npt.NDArray[np.int64], stage: str, seed: int, projection: Projection) -> Head:
        labels = np.concatenate(bins.soft_targets(data.targets[rows], config.sigma_bins), axis=1)
        return fit_head(
            data.features[rows],
            labels,
            bins.sizes,
            soft_cross_entropy,
            replace(config.training, seed=seed),
            projection=projection,
            checkpoint_dir=checkpoint_dir,
            progress=_stage(progress, stage),
        )

    components = config.training.components
    head = fit(train, "training", config.training.seed, data.projection(train, components))
    through = data.projection(everything, components)
    finders = tuple(
        fit(everything, f"finder {k + 1}", config.training.seed + _SEED_STEP * k, through)
        for k in range(config.finders)
    )
    if config.joint == "max":
        calibration.fit_scale(predict_proba(head, data.features[train]), data.targets[train])
    proba = predict_proba(head, data.features[held_out])
    calibration.calibrate(proba, data.targets[held_out])
    with_landmarks = _with_landmarks(calibration, proba, data, scene)
    modes, strangeness, local = mode_candidates(proba, bins), None, None
    found = _local_finder(data, everything, config, progress) if config.local else None
    if found is not None:  # errors of the search, as far as frames that nobody saw can tell of them
        local, answers = found
        strangeness = local.strangeness(answers)
    truth = data.sequence.require_truth()
    return PoseModel(
        backbone=data.backbone,
        head=head,
        finders=finders,
        local=local,
        landmarks=scene.landmarks,
        bins=bins,
        calibration=calibration,
        landmark_regions=with_landmarks,
        sign_reference=data.sign_reference,
        prior=_motion_prior(data, scene),
        scale=fit_spread_scale(modes, truth[held_out], strangeness),
        camera=data.sequence.camera,
        split=data.split,
        known_frames=identify(data.sequence, progress=_stage(progress, "frames to know again")),
        configuration=_record(config, data.sequence),
    )


def _with_landmarks(
    alone: SplitConformal, proba: list[npt.NDArray[Any]], data: TrainingData, scene: Scene
) -> LandmarkRegions | None:
    """The same promise for the softmax and the landmarks of the training part together."""
    if scene.region_landmarks is None:
        return None
    cells = fix_cells(alone.bins)
    rule = SplitConformal(cells, alone.alpha, alone.score, alone.joint)
    if alone.joint == "max":  # whatever the scale, it balances targets only
        rule.rule.loc_, rule.rule.scale_ = alone.rule.loc_, alone.rule.scale_
    pooled = pool_fixes(proba, scene.calibration_fixes, alone.bins, cells, data.sign_reference)
    return LandmarkRegions(scene.region_landmarks, rule.calibrate(pooled, data.targets[data.split.calibration]))


def _motion_prior(data: TrainingData, scene: Scene) -> MotionPrior:
    truth, train = data.sequence.require_truth(), data.split.train
    prior = fit_motion_prior(truth[train], data.sequence.recording[train])
    return replace(prior, depth_m=scene.depth_m, depth_spread=scene.depth_spread)


def _local_finder(
    data: TrainingData,
    frames: npt.NDArray[np.int64],
    config: ModelConfig,
    progress: Progress | None,
) -> tuple[LocalFinder, LocalAnswers] | None:
    """A local finder among `frames`, and its answers to the calibration frames when it may not see their pieces.

    None where all images look the same or there is nothing to leave out.
    """
    pieces = held_out_together(data.sequence.recording, config.split, given_test=data.sequence.given_test)
    features, targets, calibration = data.features[frames], data.targets[frames], data.split.calibration
    if len(np.unique(pieces[frames])) < 2 or not np.ptp(features, axis=0).any():
        return None
    regression, left_out = fit_local(
        features,
        targets,
        target_scale(targets),
        pieces[frames],
        views=feature_views(features.shape[1]),
        progress=_stage(progress, "neighbours"),
    )
    finder = make_finder(regression, left_out)
    if finder is None:
        return None
    queries = regression.references[np.searchsorted(frames, calibration)]
    return finder, regression.predict_projected(queries, (pieces[calibration], pieces[frames]))


def _record(config: ModelConfig, sequence: Sequence) -> dict[str, Any]:
    return {**asdict(config), "split": str(config.split), "data": sequence.name, "n_frames": len(sequence)}


def _stage(progress: Progress | None, stage: str) -> Callable[[int, int], None] | None:
    return None if progress is None else lambda done, total: progress(stage, done, total)
