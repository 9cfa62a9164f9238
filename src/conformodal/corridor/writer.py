"""Writing a flight through the corridor to disk, in the 7-Scenes layout."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image

from conformodal.core.arrays import FloatArray
from conformodal.io.folders import staged

from .path import FRAME_RATE_HZ, drone_path
from .render import Renderer
from .world import CorridorWorld


def write_corridor(
    folder: Path | str,
    *,
    n_modules: int = 5,
    n_laps: int = 2,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Fly through the corridor and write ``seq-01/frame-NNNNNN.{color.png,pose.txt}``, intrinsics and frame rate.

    The seed is that of world, path and camera noise. `progress` is called with frames done and frames in all. Returns
    the folder of the recording.
    """
    world = CorridorWorld(n_modules, seed=seed)
    renderer = Renderer(world)
    poses = drone_path(world, n_laps, seed).poses_se3
    return write_flight(Path(folder) / "seq-01", renderer, poses, noise_seed=seed * 1_000_003, progress=progress)


def write_flight(
    recording: Path,
    renderer: Renderer,
    poses_se3: FloatArray,
    *,
    noise_seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write what the camera sees from `poses_se3` (n, 4, 4) ``T_world_cam`` as a recording; returns its folder.

    Intrinsics and frame rate are written into the folder above, which may hold many recordings. Frame i has camera
    noise of seed ``noise_seed + i``. The recording is written beside its place and moved there at the end.
    """
    with staged(recording) as part:
        with ThreadPoolExecutor(max_workers=1) as writer:  # encode one frame while the next is cast
            pending = []
            for i, pose in enumerate(poses_se3):
                image = renderer.render(pose, noise_seed=noise_seed + i)
                stem = part / f"frame-{i:06d}"
                pending.append(writer.submit(Image.fromarray(image).save, f"{stem}.color.png", compress_level=1))
                np.savetxt(f"{stem}.pose.txt", pose, fmt="%.12e")
                if progress is not None:
                    progress(i + 1, len(poses_se3))
            for job in pending:
                job.result()
        np.savetxt(recording.parent / "camera-intrinsics.txt", renderer.camera.matrix)
        (recording.parent / "frame-rate.txt").write_text(f"{FRAME_RATE_HZ:g}\n", encoding="utf-8")
    return recording
