"""The worlds of the camera benchmarks, their models, which are trained once for all tables, and numbers of a run."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, REDKITCHEN, RUNS, rmse
from scipy.spatial.transform import Rotation

from conformodal.corridor import CorridorWorld, Renderer, drone_path, write_corridor, write_flight
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import TrainingConfig
from conformodal.geometry import Trajectory, pose_targets
from conformodal.io import Recording, read_recording
from conformodal.io.recording import join_recordings
from conformodal.localizer.observations import same_place
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.estimates import OdometryRun
from conformodal.pipeline.estimator import odometry_of
from conformodal.pipeline.model import ONLINE, PoseModel
from conformodal.pipeline.store import load_model, save_model
from conformodal.pipeline.train import train_model

ALPHA, FAR_M = 0.1, 0.3  # of regions; a large error
CACHE = FeatureCache(RUNS / "cache")


@dataclass(frozen=True)
class World:
    """What is mapped, and what is answered: the test part, or all frames of other recordings."""

    mapped: tuple[Path, ...]  # recordings in one world frame; none: a rendered corridor
    split: str
    answered: Path | None = None
    features: str = "xfeat"  # local ones; a corridor's images are too small for XFeat to be better
    poses: Path | None = None  # in place of those of the recording that is mapped
    focal_px: float = float("nan")  # that belongs to these
    n_laps: int = 0  # of a corridor of three modules that are mapped, each a recording; new laps are answered


TUM, FR1 = DATA / "tum", ("fr1_desk", "fr1_xyz", "fr1_rpy")
DESK, XYZ, RPY = (TUM / name for name in FR1)
SFM = REDKITCHEN.parent / "seq-01_sfm_poses.txt"  # Brachmann et al. 2021: smoother than KinectFusion's
WORLDS = {
    "redkitchen, interleaved": World((REDKITCHEN,), "interleaved"),
    "redkitchen, blocks": World((REDKITCHEN,), "blocks"),
    "corridor, interleaved": World((), "interleaved", features="orb"),
    "fr1_xyz from fr1_desk": World((DESK,), "blocks", XYZ),
    "fr1_desk from fr1_xyz": World((XYZ,), "blocks", DESK),
    "fr1_rpy from fr1_desk and fr1_xyz": World((DESK, XYZ), "blocks", RPY),
    "redkitchen by SfM, interleaved": World((REDKITCHEN,), "interleaved", poses=SFM, focal_px=525.505),
    "redkitchen by SfM, blocks": World((REDKITCHEN,), "blocks", poses=SFM, focal_px=525.505),
    "icl_living_room, blocks": World((DATA / "icl_living_room",), "blocks"),
    "corridor, new laps after three": World((), "blocks", features="orb", n_laps=3),
}
N_NEW_LAPS, LAP_MODULES = 2, 3
N_MODULES, N_LAPS = 5, 2  # of the corridor whose frames are drawn at random
# Strong dropout: in a world made of copies, a network that remembers frames tells copies apart by chance details. All
# features, not their principal components: rooms differ in small things.
TRAINING = TrainingConfig(epochs=40, dropout=0.6, components=None)
EVERY = ("head", "neighbours", "landmarks")
OTHER_FEATURES = "the other local features"
VARIANTS: dict[str, dict[str, Any]] = {  # models of their own
    "ours": {},
    OTHER_FEATURES: {},  # those that the world's model does not use
    "without landmarks": {"sources": EVERY[:2], "features": "orb"},
    "without neighbours": {"sources": EVERY[::2]},
    "without the head": {"sources": EVERY[1:]},
}


def slug(name: str) -> str:
    """A name as that of a file."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower())


def with_poses(recording: Recording, file: Path, focal_px: float) -> Recording:
    """A recording with the poses of a file of COLMAP's convention, a line per image: name, then world to camera."""
    lines = [line.split() for line in file.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    by_image = {Path(name).name.split(".")[0]: np.array(numbers, float) for name, *numbers in lines}
    rows = np.array([by_image[path.name.split(".")[0]] for path in recording.image_paths])
    turned = Rotation.from_quat(rows[:, :4], scalar_first=True).inv()
    poses = Trajectory(recording.timestamps_s, -turned.apply(rows[:, 4:]), turned.as_quat(scalar_first=True))
    return replace(recording, poses=poses, camera=replace(recording.camera, fx=focal_px, fy=focal_px))


class Laboratory:
    """Recordings and models of a world and a seed."""

    def __init__(self, name: str, seed: int) -> None:
        self.world, self.seed, self.folder = WORLDS[name], seed, RUNS / "worlds" / f"{slug(name)}-{seed}"

    def _lap(self, number: int) -> Recording:
        """A lap through the corridor of this seed, rendered first."""
        folder = self.folder / f"lap-{number}" / "seq-01"
        if not folder.is_dir():
            world = CorridorWorld(LAP_MODULES, seed=self.seed)
            path = drone_path(world, 1, seed=1000 * self.seed + number)
            write_flight(folder, Renderer(world), path.poses_se3, noise_seed=(100 * self.seed + number + 1) * 1_000_003)
        return read_recording(folder.parent)

    @cached_property
    def mapped(self) -> Recording:
        """What is mapped; a corridor is rendered first."""
        if self.world.n_laps:
            return join_recordings([self._lap(number) for number in range(self.world.n_laps)])
        corridor = self.folder / "corridor"
        if not self.world.mapped and not (corridor / "seq-01").is_dir():
            write_corridor(corridor, n_modules=N_MODULES, n_laps=N_LAPS, seed=self.seed)
        recording = join_recordings([read_recording(folder) for folder in self.world.mapped or (corridor,)])
        return recording if self.world.poses is None else with_poses(recording, self.world.poses, self.world.focal_px)

    @cached_property
    def answered(self) -> Recording:
        """What is answered."""
        if self.world.n_laps:
            return join_recordings([self._lap(self.world.n_laps + number) for number in range(N_NEW_LAPS)])
        return self.mapped if self.world.answered is None else read_recording(self.world.answered)

    def config(self, variant: str) -> ModelConfig:
        """The settings of a variant."""
        training = replace(TrainingConfig() if self.world.mapped else TRAINING, seed=self.seed)
        features = self.world.features
        if variant == OTHER_FEATURES:
            features = "orb" if features == "xfeat" else "xfeat"
        settings = {"split": self.world.split, "alpha": ALPHA, "seed": self.seed, "training": training}
        if variant == "the paper's system":
            return ModelConfig.paper(**settings)
        return ModelConfig(**settings | {"features": features} | VARIANTS[variant])

    def model(self, variant: str = "ours") -> PoseModel:
        """The model of a variant, trained unless it is there."""
        folder = self.folder / slug(variant)
        if not (folder / "model.json").is_file():
            save_model(train_model(self.mapped, self.config(variant), cache=CACHE), folder)
        return load_model(folder)

    def run(self, model: PoseModel, **changes: Any) -> OdometryRun:
        """A model's answers; `changes` are those of the recording."""
        frames = model.split.test if self.answered is self.mapped else self.answered.posed
        return odometry_of(model).process(replace(self.answered, **changes), frames)

    def truth(self, run: OdometryRun) -> Trajectory:
        """True poses of the frames of a run."""
        poses = self.answered.poses
        assert poses is not None
        return poses[np.searchsorted(self.answered.posed, run.frames)]


def frame_by_frame(lab: Laboratory, run: OdometryRun) -> dict[str, dict[str, list[float]]]:
    """Errors and regions of every frame, by what they rest on; an unbounded region has length -1."""
    truth = lab.truth(run)
    targets = pose_targets(truth, run.model.sign_reference)
    alone = np.array([e.candidates.positions_xyz[np.argmax(e.candidates.log_weights)] for e in run.estimates])
    positions = {"image alone": alone, **{name: path.positions_xyz for name, path in run.trajectories.items()}}
    by_name: dict[str, dict[str, list[float]]] = {}
    for name, regions in {"image alone": run.regions, **run.path_regions}.items():
        bounded = ~regions.unbounded.any(axis=1)
        by_name[name] = {
            "held": regions.contains(targets, joint=True).tolist(),
            "length_m": np.where(bounded, regions.length[:, :3].mean(axis=1), -1.0).tolist(),
            "places": np.where(bounded, regions.n_places, 0).tolist(),
        }
    for name, xyz in positions.items():
        by_name.setdefault(name, {})["off_m"] = np.linalg.norm(xyz - truth.positions_xyz, axis=1).tolist()
    by_name[ONLINE]["squared"] = squared_errors(run, truth)
    answer = by_name[run.answer]
    answer["reliable"] = run.reliable.tolist()
    elsewhere = ~same_place(run.trajectory, truth.positions_xyz, truth.orientations_quat_wxyz, run.model.prior)
    answer["elsewhere"] = (run.reliable & elsewhere).tolist()
    return by_name


def squared_errors(run: OdometryRun, truth: Trajectory) -> list[float]:
    """Squared errors of the poses that a stream gives, over the covariance that it states."""
    squared = []
    for estimate, xyz, quat in zip(run.estimates, truth.positions_xyz, truth.orientations_quat_wxyz, strict=True):
        assert estimate.pose is not None
        turned = Rotation.from_quat(estimate.pose.orientation_quat_wxyz, scalar_first=True)
        turn = (Rotation.from_quat(quat, scalar_first=True) * turned.inv()).as_rotvec()
        off = np.concatenate((xyz - estimate.pose.position_xyz, turn))
        squared.append(float(off @ np.linalg.solve(estimate.covariance, off)))
    return squared


def summary(frames: dict[str, list[float]]) -> dict[str, float]:
    """Statistics over the frames of one run."""
    numbers: dict[str, float] = {}
    if "off_m" in frames:
        off = np.array(frames["off_m"])
        numbers |= {"rmse_m": rmse(off), "median_m": float(np.median(off)), "far": float(np.mean(off > FAR_M))}
    if "held" in frames:
        lengths, held = np.array(frames["length_m"]), np.array(frames["held"])
        bounded = lengths >= 0
        numbers |= {
            "bounded": float(bounded.mean()),
            "coverage": float(held.mean()),
            "of bounded": float(held[bounded].mean()),
            "places": float(np.array(frames["places"])[bounded].mean()),
            "length_m": float(np.median(lengths[bounded])),
        }
    return numbers | {key: float(np.mean(frames[key])) for key in ("reliable", "elsewhere") if key in frames}
