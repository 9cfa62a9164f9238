"""Training and calibrating a pose model on recordings with poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from conformodal.core.files import default_cache_dir
from conformodal.core.progress import StageProgress, stage_of
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.networks import backbone_config, make_backbone, make_detector
from conformodal.geometry import pose_targets, sign_reference
from conformodal.io import Recording, make_split, with_random_calibration
from conformodal.io.recording import join_recordings
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.observations import fit_motion_prior
from conformodal.localizer.regions import PlaceNovelty
from conformodal.localizer.rooms import Rooms
from conformodal.localizer.sources.registry import find_source
from conformodal.localizer.training_data import TrainingData
from conformodal.tracking.depths import UNKNOWN_DEPTH, scene_depth

from .calibrate import calibrate_disturbed, calibrate_regions, compare_sources
from .calibrate_paths import calibrate_paths
from .config import Method, ModelConfig, OdometryError
from .folds import make_folds, settings_record
from .identity import identify
from .model import ExpectedInput, PoseModel
from .paper import train_paper


def prepare_training_data(
    sequence: Recording, config: ModelConfig, cache: FeatureCache, progress: StageProgress | None = None
) -> TrainingData:
    """Split a sequence with poses and compute the features of all its frames."""
    truth, paper = sequence.require_truth(), config.method is Method.PAPER
    split = make_split(
        sequence.recording,
        config.split,
        seed=config.seed,
        test=config.test,
        calibration=config.calibration,
        used=config.used,
        given_test=sequence.given_test,
    )
    if paper:
        split = with_random_calibration(split, config.calibration / (config.used or 1 - config.test))
    size = sequence.camera.width, sequence.camera.height
    network = backbone_config(*size, config.network, whole=paper)
    backbone, detector = make_backbone(network, cache), make_detector(config.features, sequence.camera)
    reference = sign_reference(truth.orientations_quat_wxyz[split.train])
    targets = pose_targets(truth, reference)
    features = extract_features(sequence.image_paths, backbone, cache, stage_of(progress, "features"), sequence.noise)
    return TrainingData(
        sequence,
        split,
        features,
        targets,
        reference,
        backbone=backbone,
        cache=cache,
        detector=detector,
        depth=UNKNOWN_DEPTH if paper else scene_depth(sequence, split.train, detector),
        settings=config.for_sources,
        progress=progress,
        grid=network.grid,
    )


def train_model(
    data: Recording | Sequence[Recording] | TrainingData,
    config: ModelConfig | None = None,
    *,
    cache: FeatureCache | None = None,
    progress: StageProgress | None = None,
) -> PoseModel:
    """Train on the training part of recordings and calibrate; nothing is chosen on the test part.

    Where frames calibrate, the sources learn from the training part. Where stretches do, each stretch of training and
    calibration part is answered by sources that learnt from the others, and the model's own learn from all of them;
    the scores of both are compared on some frames of the test part. ``examples/images.py`` trains on images with poses.

    Parameters
    ----------
    data
        Recordings with poses, in one world frame; or what :func:`prepare_training_data` made of them.
    config, cache
        Settings, and where features are kept for the next training: the user's cache.
    progress
        Called with stage, parts done and parts in all.
    """
    config = ModelConfig() if config is None else config
    if not isinstance(data, TrainingData):
        whole = join_recordings([data] if isinstance(data, Recording) else list(data))
        data = prepare_training_data(
            whole, config, FeatureCache(default_cache_dir()) if cache is None else cache, progress
        )
    if data.detector.name != config.features:
        raise OdometryError(f"features are {config.features!r}, those of the data {data.detector.name!r}")
    if (data.settings, data.progress) != (config.for_sources, progress):
        data = replace(data, settings=config.for_sources, progress=progress)
    return train_paper(data, config) if config.method is Method.PAPER else _train(data, config)


def _train(data: TrainingData, config: ModelConfig) -> PoseModel:
    """Train and calibrate this project's system."""
    sequence, split = data.sequence, data.split
    folds = make_folds(sequence, split, config.calibrate_on, config.alpha)
    parts = [fold.train for fold in folds.folds]
    if len(parts) > 1 or not np.array_equal(parts[0], folds.region_frames):
        parts.append(folds.region_frames)
    local = any(find_source(name).local for name in config.sources)
    stretches = folds.units is not None
    if stretches:
        motions = data.run_front_end(np.union1d(folds.region_frames, folds.held_out), local=local, motions=True)
    else:
        if local:
            data.run_front_end(folds.region_frames, local=True, motions=False)
        motions = data.run_front_end(folds.held_out, local=local, motions=True)
    *localizers, localizer = Localizer.fit_each(data, parts, config.sources)
    localizers = localizers or [localizer]
    prior = fit_motion_prior(sequence.require_truth()[split.train], sequence.recording[split.train])
    prior = replace(prior, depth_m=data.depth.median_m, depth_spread=data.depth.log_spread)
    known, backbone = folds.region_frames, data.require_backbone()
    novelty = PlaceNovelty.fit(data.features[known], folds.pieces[known], backbone.config.grid)
    rooms = Rooms.of(data.targets[known, :3], sequence.recording[known], data.depth.median_m)
    frames_alone = calibrate_regions(data, folds, localizers, novelty, config, motions, rooms)
    path_rules = calibrate_paths(data, folds, localizers, frames_alone, prior, motions, rooms)
    regions = calibrate_disturbed(data, folds, localizers, frames_alone)
    comparison = None
    if stretches:
        comparison = compare_sources(data, localizers, localizer, regions.novelty, regions.rules, split.test, rooms)
    return PoseModel(
        backbone=backbone,
        localizer=localizer,
        novelty=regions.novelty,
        rules=regions.rules,
        prior=prior,
        camera=sequence.camera,
        split=split,
        known_frames=identify(sequence),
        expected_input=ExpectedInput.of(sequence),
        configuration=settings_record(config, sequence, folds),
        comparison=comparison,
        path_rules=path_rules,
        quality=regions.quality,
        detector=data.detector,
        rooms=rooms,
    )
