"""Training and calibrating a pose model on recordings with poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from conformodal.core.extras import require_extra
from conformodal.core.files import default_cache_dir
from conformodal.core.progress import StageProgress, stage_of
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.geometry import RelativeMotion, sign_reference
from conformodal.io import Recording, make_split, with_random_calibration
from conformodal.io.recording import join_recordings
from conformodal.localizer.candidates import pose_targets
from conformodal.localizer.localizer import Localizer
from conformodal.localizer.observations import fit_motion_prior
from conformodal.localizer.regions import PlaceNovelty
from conformodal.localizer.rooms import Rooms
from conformodal.localizer.sources.registry import find_source

from .calibrate import (
    CalibratedRegions,
    calibrate_disturbed,
    calibrate_paths,
    calibrate_regions,
    compare_sources,
    paper_rules,
)
from .config import Method, ModelConfig, OdometryError
from .identity import identify
from .model import ExpectedInput, PathRule, PoseModel
from .training_data import TrainingData, make_folds


def prepare_training_data(
    sequence: Recording, config: ModelConfig, cache: FeatureCache, progress: StageProgress | None = None
) -> TrainingData:
    """Split a sequence with poses and compute the features of all its frames."""
    with require_extra("train", "training"):
        from conformodal.features.export import make_backbone, make_detector  # noqa: PLC0415
        from conformodal.features.networks import backbone_config  # noqa: PLC0415

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
    if config.method is Method.PAPER:
        split = with_random_calibration(split, config.calibration / (config.used or 1 - config.test))
    size = sequence.camera.width, sequence.camera.height
    network = backbone_config(*size, config.network, whole=config.method is Method.PAPER)
    backbone, detector = make_backbone(network, cache), make_detector(config.features, sequence.camera, cache)
    reference = sign_reference(truth.orientations_quat_wxyz[split.train])
    targets = pose_targets(truth, reference)
    features = extract_features(sequence.image_paths, backbone, cache, stage_of(progress, "features"), sequence.noise)
    return TrainingData(sequence, split, backbone, features, targets, reference, cache, detector)


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
    folds = make_folds(data.sequence, data.split, config.calibrate_on, config.alpha)
    sources = data.for_sources(config, progress)
    parts = [fold.train for fold in folds.folds]
    if len(parts) > 1 or not np.array_equal(parts[0], folds.region_frames):
        parts.append(folds.region_frames)
    motions: dict[int, RelativeMotion | None] = {}
    local = any(find_source(name).local for name in config.sources)
    stretches = folds.units is not None
    if config.method is not Method.PAPER and stretches:
        motions = sources.run_front_end(np.union1d(folds.region_frames, folds.held_out), local=local, motions=True)
    elif config.method is not Method.PAPER:
        if local:
            sources.run_front_end(folds.region_frames, local=True, motions=False)
        motions = sources.run_front_end(folds.held_out, local=local, motions=True)
    *localizers, localizer = Localizer.fit_each(sources, parts, config.sources)
    localizers, train = localizers or [localizer], data.split.train
    prior = fit_motion_prior(data.sequence.require_truth()[train], data.sequence.recording[train])
    if config.method is not Method.PAPER:
        depth_m, depth_spread = data.depths
        prior = replace(prior, depth_m=depth_m, depth_spread=depth_spread)
    path_rules: dict[str, PathRule] = {}
    rooms: Rooms | None = None
    if config.method is Method.PAPER:  # without a novelty test
        regions = CalibratedRegions(paper_rules(sources, folds.held_out, localizer, config), None, [])
    else:
        features, pieces = data.features[folds.region_frames], folds.pieces[folds.region_frames]
        novelty = PlaceNovelty.fit(features, pieces, data.backbone.config.grid)
        known = folds.region_frames
        rooms = Rooms.of(data.targets[known, :3], data.sequence.recording[known], data.depths[0])
        frames_alone = calibrate_regions(sources, folds, localizers, novelty, config, motions, rooms)
        path_rules = calibrate_paths(sources, folds, localizers, frames_alone, prior, motions, rooms)
        regions = calibrate_disturbed(sources, data.backbone, data.cache, folds, localizers, frames_alone, progress)
    rules, novelty = regions.rules, regions.novelty
    test = data.split.test
    return PoseModel(
        backbone=data.backbone,
        localizer=localizer,
        novelty=novelty,
        rules=rules,
        prior=prior,
        camera=data.sequence.camera,
        split=data.split,
        known_frames=identify(data.sequence),
        expected_input=ExpectedInput.of(data.sequence),
        configuration=config.record(data.sequence.name, len(data.sequence), "stretches" if stretches else "frames")
        | {"whole_recordings": folds.whole_recordings, "unit": data.sequence.unit},
        comparison=compare_sources(sources, localizers, localizer, novelty, rules, test, rooms) if stretches else None,
        path_rules=path_rules,
        quality=regions.quality,
        detector=data.detector,
        rooms=rooms,
    )
