"""Small rendered clips: a camera that moves sideways in a room, one that only turns, one in another room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from conformodal.corridor.flight import rotation_world_cam
from conformodal.corridor.render import Renderer
from conformodal.corridor.world import CorridorWorld
from conformodal.geometry import PinholeCamera, Trajectory, rigid_motions
from conformodal.mapping import MapSettings

CAMERA = PinholeCamera(260.0, 260.0, 159.5, 119.5, 320, 240)
N_FRAMES = 24


def sweep(x0: float) -> Trajectory:
    """Poses of a camera that looks at the back of a room, moves to the side, up and down, and turns a little."""
    t = np.linspace(0, 1, N_FRAMES)
    yaw = np.radians(90 + 14 * np.sin(2 * np.pi * t))
    pitch = np.radians(5 * np.cos(2 * np.pi * t))
    positions = np.column_stack(
        (x0 + 1.1 + 1.5 * t, 3.3 + 0.35 * np.sin(3 * np.pi * t), 1.3 + 0.25 * np.sin(4 * np.pi * t))
    )
    poses = rigid_motions(rotation_world_cam(yaw, pitch, np.zeros(N_FRAMES)), positions)
    return Trajectory.from_poses_se3(np.arange(N_FRAMES) / 10.0, poses)


def turn(x0: float) -> Trajectory:
    """Poses of a camera that turns on the spot."""
    yaw = np.radians(60 + 60 * np.linspace(0, 1, N_FRAMES))
    still = np.zeros(N_FRAMES)
    places = np.tile([x0 + 1.9, 3.2, 1.3], (N_FRAMES, 1))
    poses = rigid_motions(rotation_world_cam(yaw, still, still), places)
    return Trajectory.from_poses_se3(np.arange(N_FRAMES) / 10.0, poses)


def render(folder: Path, path: Trajectory, seed: int = 0) -> Path:
    """Images ``000.png`` and so on of a path."""
    renderer = Renderer(CorridorWorld(2, seed=seed), CAMERA)
    folder.mkdir(parents=True)
    for k, pose in enumerate(path.poses_se3):
        Image.fromarray(np.asarray(renderer.render(pose, noise_seed=k))).save(folder / f"{k:03d}.png")
    return folder


SETTINGS = MapSettings(max_features=800, neighbours=(1, 2, 3, 4), retrieved=2)


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(tmp_path_factory.mktemp("clips") / "room", sweep(4.0))


@pytest.fixture(scope="session")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(tmp_path_factory.mktemp("clips") / "turning", turn(4.0))


@pytest.fixture(scope="session")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(tmp_path_factory.mktemp("clips") / "elsewhere", sweep(0.0), seed=7)
