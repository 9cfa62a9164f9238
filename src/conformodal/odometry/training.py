"""Training and calibrating a pose model on a sequence with poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins
from conformodal.datasets import Sequence, held_out_together, make_split
from conformodal.poses import sign_reference
from conformodal.reasoning import (
    MotionPrior,
    fit_motion_prior,
    fit_spread_scale,
    mode_candidates,
)
from conformodal.vision import (
    Backbone,
    BackboneConfig,
    FeatureCache,
    Head,
    LocalAnswers,
    extract_features,
    feature_views,
    fine_tune,
    fit_head,
    fit_local,
    pick_device,
    predict_proba,
    soft_cross_entropy,
)

from .calibrating import FoldPrediction, bins_of, calibrate_regions
from .config import Method, ModelConfig, record_of
from .folds import make_folds
from .identity import identify
from .known import KnownPlaces
from .local import LocalFinder, make_finder
from .model import PoseModel
from .motions import Progress, stage_of
from .paper import train_paper
from .scene import Scene, learn_scene
from .targets import pose_targets, target_scale
from .training_data import TrainingData

IntArray = npt.NDArray[np.int64]

_SEED_STEP = 1000  # between heads that are averaged


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
    size = sequence.camera.width, sequence.camera.height
    backbone = Backbone(BackboneConfig.for_images(*size, config.network, whole=config.method is Method.PAPER))
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
            stage_of(progress, "fine-tuning"),
        )
    stage = stage_of(progress, "features")
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
    """Train on the training part and calibrate; the test part is not touched.

    The finders are trained on training and calibration part: the region must not know the frames that calibrate it, but
    the search for the pose, of which nothing is promised, may, as a plain regressor would. So does the scene, which is
    learnt from both as well unless it is given. Of the paper's method there are a head and its calibration alone.
    """
    if config.method is Method.PAPER:
        return train_paper(data, config, checkpoint_dir=checkpoint_dir, progress=progress)
    folds = make_folds(data.sequence, data.split, config.calibrate_on, config.alpha)
    if scene is None:
        scene = learn_scene(data.sequence, data.split, folds, landmarks=config.landmarks, progress=progress)
    scene.check_folds(folds)
    everything = np.sort(np.concatenate((data.split.train, data.split.calibration)))
    seed = config.training.seed

    def fit(rows: IntArray, bins: QuantileBins, stage: str, seed: int = seed) -> Head:
        labels = np.concatenate(bins.soft_targets(data.targets[rows], config.sigma_bins), axis=1)
        return fit_head(
            data.features[rows],
            labels,
            bins.sizes,
            soft_cross_entropy,
            replace(config.training, seed=seed),
            projection=data.projection(rows, config.training.components),
            checkpoint_dir=checkpoint_dir,
            progress=stage_of(progress, stage),
        )

    own_bins = bins_of(data, folds.region_frames, config)
    heads, fold_bins = [], []
    for k, fold in enumerate(folds.folds):
        fold_bins.append(bins_of(data, fold.train, config))  # values beyond them count against calibration
        stage = f"training, part {k + 1}" if len(folds.folds) > 1 else "training"
        heads.append(fit(fold.train, fold_bins[-1], stage))
    predictions = [
        FoldPrediction(fold, bins, predict_proba(head, data.features[fold.held_out]))
        for fold, bins, head in zip(folds.folds, fold_bins, heads, strict=True)
    ]
    finders = tuple(fit(everything, own_bins, f"finder {k + 1}", seed + _SEED_STEP * k) for k in range(config.finders))
    # sources of the region that learn from all frames are those of the search
    head = finders[0] if len(folds.region_frames) == len(everything) else heads[-1]
    known = KnownPlaces.fit(data.features[folds.region_frames], folds.pieces[folds.region_frames])
    rules = calibrate_regions(data, folds, predictions, scene, known, config)
    modes = [candidates for part in predictions for candidates in mode_candidates(part.proba, part.bins)]
    strangeness, local = None, None
    found = _local_finder(data, everything, folds.held_out, config, progress) if config.local else None
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
        region_landmarks=scene.region_landmarks,
        known=known,
        bins=own_bins,
        rules=rules,
        sign_reference=data.sign_reference,
        prior=_motion_prior(data, scene),
        scale=fit_spread_scale(modes, truth[folds.held_out], strangeness),
        camera=data.sequence.camera,
        split=data.split,
        known_frames=identify(data.sequence),
        configuration=record_of(
            config, data.sequence.name, len(data.sequence), "frames" if folds.units is None else "stretches"
        ),
    )


def _motion_prior(data: TrainingData, scene: Scene) -> MotionPrior:
    truth, train = data.sequence.require_truth(), data.split.train
    prior = fit_motion_prior(truth[train], data.sequence.recording[train])
    return replace(prior, depth_m=scene.depth_m, depth_spread=scene.depth_spread)


def _local_finder(
    data: TrainingData,
    frames: IntArray,
    held_out: IntArray,
    config: ModelConfig,
    progress: Progress | None,
) -> tuple[LocalFinder, LocalAnswers] | None:
    """A local finder among `frames`, and its answers to those `held_out` when it may not see their pieces.

    None where all images look the same or there is nothing to leave out.
    """
    pieces = held_out_together(data.sequence.recording, config.split, given_test=data.sequence.given_test)
    features, targets = data.features[frames], data.targets[frames]
    if len(np.unique(pieces[frames])) < 2 or not np.ptp(features, axis=0).any():
        return None
    regression, left_out = fit_local(
        features,
        targets,
        target_scale(targets),
        pieces[frames],
        views=feature_views(features.shape[1]),
        progress=stage_of(progress, "neighbours"),
    )
    finder = make_finder(regression, left_out)
    if finder is None:
        return None
    queries = regression.references[np.searchsorted(frames, held_out)]
    return finder, regression.predict_projected(queries, (pieces[held_out], pieces[frames]))
