"""Writing a flight through the corridor to disk, in the 7-Scenes layout."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image

from conformodal.poses import PinholeCamera

from .path import FRAME_RATE_HZ, drone_path
from .render import Renderer
from .world import CorridorWorld


def write_corridor(
    folder: Path,
    *,
    n_modules: int = 5,
    n_laps: int = 2,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Fly through the corridor and write ``seq-01/frame-NNNNNN.{color.png,pose.txt}``, intrinsics and frame rate.

    Parameters
    ----------
    folder
        Where to; created if missing.
    n_modules, n_laps, seed
        Of world, path and camera noise.
    progress
        Called with frames done and frames in all.

    Returns
    -------
    Path
        The folder of the recording.
    """
    world = CorridorWorld(n_modules, seed=seed)
    renderer = Renderer(world)
    poses = drone_path(world, n_laps, seed).poses_se3
    recording = folder / "seq-01"
    recording.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "camera-intrinsics.txt", intrinsic_matrix(renderer.camera))
    (folder / "frame-rate.txt").write_text(f"{FRAME_RATE_HZ:g}\n", encoding="utf-8")
    with ThreadPoolExecutor(max_workers=1) as writer:  # encode one frame while the next is cast
        pending = []
        for i, pose in enumerate(poses):
            image = renderer.render(pose, noise_seed=seed * 1_000_003 + i)
            stem = recording / f"frame-{i:06d}"
            pending.append(writer.submit(Image.fromarray(image).save, f"{stem}.color.png", compress_level=1))
            np.savetxt(f"{stem}.pose.txt", pose, fmt="%.12e")
            if progress is not None:
                progress(i + 1, len(poses))
        for job in pending:
            job.result()
    return recording


def intrinsic_matrix(camera: PinholeCamera) -> np.ndarray:
    """The 3x3 matrix K of a camera."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
