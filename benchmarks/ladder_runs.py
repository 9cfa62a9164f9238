"""What the ladder is measured on: places, seeds, and the models of each, kept in a folder so that a run resumes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
from common import DATA
from safetensors.numpy import load_file, save_file

from conformodal.cli.demo import N_LAPS, N_MODULES, TRAINING
from conformodal.core.caching import default_cache_dir
from conformodal.datasets import Sequence, SplitKind, held_out_together, read_sequence, read_sevenscenes
from conformodal.datasets.corridor.writer import write_corridor
from conformodal.localization.landmarks.source import LandmarkSource
from conformodal.localization.local_features import LocalFeatures, Matcher
from conformodal.localization.neighbours.source import NeighbourSource
from conformodal.localization.neighbours.tuning import fit_local
from conformodal.localization.source import PoseSource, SourceState
from conformodal.localization.source_data import SourceData
from conformodal.localization.targets import target_scale
from conformodal.model.config import Calibration, ModelConfig
from conformodal.model.model import PoseModel
from conformodal.model.store import load_model, save_model
from conformodal.training.training import prepare_training_data, train_model
from conformodal.training.training_data import TrainingData
from conformodal.vision.backbone import BackboneConfig, feature_views
from conformodal.vision.features import FeatureCache
from conformodal.vision.settings import TrainingConfig

ALPHA = 0.1
LARGER = "efficientnet_lite2"
REDKITCHEN = ("redkitchen, interleaved", "redkitchen, blocks")
PLACES = (*REDKITCHEN, "corridor", "TUM cabinet", "KITTI 06")
FloatArray = npt.NDArray[np.float64]


def sequence_of(place: str, seed: int, folder: Path) -> Sequence:
    """The frames of a place; a corridor is written to `folder` first."""
    if place in REDKITCHEN:
        return read_sevenscenes(DATA / "7scenes" / "redkitchen" / "seq-01")
    if place == "TUM cabinet":
        return read_sequence(DATA / "tum" / "fr3_cabinet")
    if place == "KITTI 06":
        return read_sequence(DATA / "kitti" / "sequences" / "06")
    if not (folder / "world.done").is_file():
        write_corridor(folder / "world", n_modules=N_MODULES, n_laps=N_LAPS, seed=seed)
        (folder / "world.done").touch()
    return read_sevenscenes(folder / "world")


def config_of(place: str, seed: int, **settings: Any) -> ModelConfig:
    """Ours; frames calibrate in every split, so that the parts of all places are the same."""
    training = replace(TRAINING, seed=seed) if place == "corridor" else TrainingConfig(seed=seed)
    split = SplitKind.BLOCKS if place.endswith("blocks") else SplitKind.INTERLEAVED
    common = {"seed": seed, "split": split, "alpha": ALPHA, "training": training, "calibrate_on": Calibration.FRAMES}
    return ModelConfig(**{**common, **settings})


def averaged(features: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Features (n, F) whose map is its mean over the image everywhere."""
    views = feature_views(features.shape[1])
    rows, columns = BackboneConfig.grid
    network = features[:, views.network].reshape(len(features), -1, rows * columns)
    flat = np.broadcast_to(network.mean(axis=2, keepdims=True), network.shape).reshape(len(features), -1)
    return np.concatenate((flat, features[:, views.thumbnail]), axis=1)


@dataclass(frozen=True)
class Trained:
    """A model, the features that it sees of all frames, and the seconds of its stages of training."""

    model: PoseModel
    features: npt.NDArray[np.float32]
    seconds: dict[str, float]


class Stages:
    """Seconds by stage, from calls of a progress function."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._since = "features", time.perf_counter()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """A call of the progress function."""
        now = time.perf_counter()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._stage, self._since = stage, now


class Models:
    """All models of a place and a seed; those that the folder has are not trained again."""

    def __init__(self, place: str, seed: int, runs: Path) -> None:
        self.place, self.seed = place, seed
        self.folder = runs / f"{place.replace(', ', '-').replace(' ', '-')}-{seed}"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.sequence = sequence_of(place, seed, self.folder)
        self.cache = FeatureCache(self.folder if place == "corridor" else default_cache_dir())
        self._local_features: dict[int, LocalFeatures] = {}
        self._matcher = Matcher()
        self._maps: dict[bytes, LandmarkSource | None] = {}
        self._fit_landmarks = LandmarkSource.fit

    def ours(self) -> Trained:
        """Ours, as it is."""
        return self._kept("ours", config_of(self.place, self.seed))

    def unlabelled(self) -> Trained:
        """Ours with one-hot labels."""
        return self._kept("one-hot", config_of(self.place, self.seed, sigma_bins=0.0))

    def averaged(self) -> Trained:
        """Ours with features averaged over the image."""
        return self._kept("averaged", config_of(self.place, self.seed), averaged)

    def unprojected(self) -> Trained | None:
        """Ours with all features; None where ours has them anyway."""
        config = config_of(self.place, self.seed)
        if config.training.components is None:
            return None
        return self._kept("unprojected", replace(config, training=replace(config.training, components=None)))

    def larger(self) -> Trained | None:
        """Ours with a larger network; on the real video only."""
        if self.place not in REDKITCHEN:
            return None
        return self._kept("larger", config_of(self.place, self.seed, network=LARGER))

    def paper(self) -> Trained:
        """The paper's system."""
        ours = config_of(self.place, self.seed)
        config = ModelConfig.paper(seed=self.seed, split=ours.split, alpha=ALPHA, training=ours.training)
        return self._kept("paper", config)

    def step(self, name: str, *, projected: bool) -> Trained:
        """The paper's labels, bins and score on the map of features."""
        ours = config_of(self.place, self.seed)
        training = ours.training if projected else replace(ours.training, components=None)
        bare = {"margin": 0.0, "sigma_bins": 0.0, "score": "lac", "joint": "none", "novelty_level": 0.0}
        return self._kept(name, replace(ours, training=training, **bare, sources=("head",)))

    def neighbours(self, view: str) -> PoseSource | None:
        """Neighbours by one kind of features alone: ``network`` or ``thumbnail``, the global descriptor."""
        ours = self.ours()
        file = self.folder / f"neighbours-{view}.json"
        weights = file.with_suffix(".safetensors")
        if file.is_file():
            return NeighbourSource.from_state(SourceState(load_file(weights), json.loads(file.read_text())))
        frames = ours.model.split.train
        config = config_of(self.place, self.seed)
        data = prepare_training_data(self.sequence, config, self.cache)
        targets = data.targets[frames]
        pieces = held_out_together(self.sequence.recording, config.split, given_test=self.sequence.given_test)[frames]
        views = (getattr(feature_views(ours.features.shape[1]), view),)
        fitted = fit_local(ours.features[frames], targets, target_scale(targets), pieces, views=views)
        found = NeighbourSource.of(*fitted, frames)
        if found is not None:
            state = found.state()
            save_file({k: np.ascontiguousarray(v) for k, v in state.arrays.items()}, weights)
            file.write_text(json.dumps(state.settings))
        return found

    def data(self, config: ModelConfig, stages: Stages | None = None) -> TrainingData:
        """Frames, split and features."""
        return prepare_training_data(self.sequence, config, self.cache, stages)

    def _landmarks(self, data: SourceData, frames: npt.NDArray[np.int64]) -> LandmarkSource | None:
        """A map does not depend on the network: the models of a place and seed share those of the same frames."""
        key = frames.tobytes()
        if key not in self._maps:
            self._maps[key] = self._fit_landmarks(data, frames)
        return self._maps[key]

    def _kept(
        self,
        name: str,
        config: ModelConfig,
        seen_as: Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]] | None = None,
    ) -> Trained:
        folder, stages = self.folder / name, Stages()
        data = self.data(config, stages)
        if seen_as is not None:
            data = replace(data, features=seen_as(data.features))
        if not (folder / "seconds.json").is_file():
            data._shared._local_features, data._shared.matcher = self._local_features, self._matcher
            with patch.object(LandmarkSource, "fit", self._landmarks):
                model = train_model(data, config, progress=stages)
            stages("end", 0, 0)
            save_model(model, folder)
            (folder / "seconds.json").write_text(json.dumps(stages.seconds))
        return Trained(load_model(folder), data.features, json.loads((folder / "seconds.json").read_text()))
