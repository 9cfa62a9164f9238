"""Smooth, drone-like paths along the corridor and back, into every room, and recordings of them on disk."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.core.progress import Progress
from conformodal.geometry import Trajectory, rigid_motions
from conformodal.io.folders import staged

from .render import Renderer
from .world import DOOR_CENTRE, HALL_WIDTH, MODULE_LENGTH, ROOM_NEAR, CorridorWorld

FRAME_RATE_HZ = 10.0
STEP_M = 0.15  # between frames, at cruising speed
TURN_RAD = np.radians(7.0)
CRUISE_HEIGHT_M = 1.3
FROM_END_M = 0.8  # where the drone turns back
SMOOTHING_FRAMES = 2.0
GUST_M, GUST_RAD, GUST_FRAMES = 0.05, np.radians(1.2), 1.0

Waypoint = tuple[float, float, float]  # x, y, yaw in degrees; yaw 0 looks along x, 90 into the rooms


def drone_path(
    world: CorridorWorld, n_laps: int = 2, seed: int | tuple[int, int] = 0, speed: float = 1.0
) -> Trajectory:
    """Poses ``T_world_cam`` of an inspection flight, seeded, at 10 frames per second.

    Each of `n_laps` laps goes along the hall and back and into every room, always in the same manner, so that flying
    does not tell rooms apart that look alike. Gusts move the drone by some centimetres and degrees, fast enough that a
    frame is no more like its neighbours in time than like those of another visit. The drone moves sideways where it has
    to: the camera never looks straight at the hall side opposite the rooms. Its cruising speed is 1.5 m/s times
    `speed`.
    """
    lap = [*_way_there(world), *_way_back(world)]
    return fly(lap * n_laps, np.random.default_rng(seed), speed)


def drone_pass(world: CorridorWorld, seed: int | tuple[int, int] = 0, speed: float = 1.0) -> Trajectory:
    """The first half of a lap of :func:`drone_path`: from end to end, and into every room."""
    return fly(_way_there(world), np.random.default_rng(seed), speed)


def fly(waypoints: list[Waypoint], rng: np.random.Generator, speed: float = 1.0) -> Trajectory:
    """A smooth flight from waypoint to waypoint, shaken by gusts."""
    coarse = np.array(waypoints)
    coarse[:, 2] = np.radians(coarse[:, 2])
    step = np.diff(coarse, axis=0)
    effort = np.maximum(np.hypot(step[:, 0], step[:, 1]) / STEP_M, np.abs(step[:, 2]) / TURN_RAD)
    clock = np.concatenate(([0.0], np.cumsum(effort))) / speed
    n = int(clock[-1])
    x, y, yaw = (
        gaussian_filter1d(np.interp(np.arange(n), clock, column), SMOOTHING_FRAMES, mode="nearest")
        for column in coarse.T
    )
    x, y, z = (a + GUST_M * _wander(n, GUST_FRAMES, rng) for a in (x, y, np.full(n, CRUISE_HEIGHT_M)))
    yaw, pitch, roll = (a + GUST_RAD * _wander(n, GUST_FRAMES, rng) for a in (yaw, np.zeros(n), np.zeros(n)))
    poses = rigid_motions(rotation_world_cam(yaw, pitch, roll), np.column_stack((x, y, z)))
    return Trajectory.from_poses_se3(np.arange(n) / FRAME_RATE_HZ, poses)


def rotation_world_cam(yaw: npt.ArrayLike, pitch: npt.ArrayLike = 0.0, roll: npt.ArrayLike = 0.0) -> FloatArray:
    """Rotation matrices (n, 3, 3) of a camera (x right, y down, z forward) that looks along `yaw`, in radians.

    Yaw turns from +x to +y, positive pitch looks up, positive roll dips the right side.
    """
    yaw, pitch, roll = np.broadcast_arrays(*(np.atleast_1d(np.asarray(a, float)) for a in (yaw, pitch, roll)))
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along +x, z up
    attitude = Rotation.from_euler("ZYX", np.column_stack((yaw, -pitch, roll)))
    return np.asarray(attitude.as_matrix() @ level)


def _way_there(world: CorridorWorld) -> list[Waypoint]:
    """Along the hall and into every room."""
    middle = HALL_WIDTH / 2
    visits = [point for k in range(world.n_modules) for point in _visit(k, 0.0)]
    return [(FROM_END_M, middle, 0.0), *visits, (world.length - FROM_END_M, middle, 0.0)]


def _way_back(world: CorridorWorld) -> list[Waypoint]:
    """From where the way there ends.

    The drone turns round only at doors, as on a visit, and backs away from the ends.
    """
    middle, first, last = HALL_WIDTH / 2, DOOR_CENTRE, world.length - MODULE_LENGTH + DOOR_CENTRE
    west, east = FROM_END_M, world.length - FROM_END_M
    visits = [point for k in reversed(range(world.n_modules)) for point in _visit(k, 180.0)]
    turn = [(last, middle, 0.0), (last, middle, 90.0), (last, middle, 180.0), (east, middle, 180.0)]
    turn_again = [(west, middle, 180.0), (first, middle, 180.0), (first, middle, 90.0), (first, middle, 0.0)]
    return [*turn, *visits, *turn_again]


def _visit(k: int, heading: float) -> list[Waypoint]:
    """Stop at the door, turn, enter, look around, back out, turn again."""
    door, middle = k * MODULE_LENGTH + DOOR_CENTRE, HALL_WIDTH / 2
    return [
        (door, middle, heading),
        (door, middle, 90.0),
        (door, ROOM_NEAR + 0.4, 90.0),
        (door + 0.4, ROOM_NEAR + 1.2, 145.0),
        (door - 0.4, ROOM_NEAR + 1.2, 35.0),
        (door, ROOM_NEAR + 0.4, 90.0),
        (door, middle, 90.0),
        (door, middle, heading),
    ]


def _wander(n: int, sigma_frames: float, rng: np.random.Generator) -> FloatArray:
    """Smooth noise of unit spread."""
    noise = gaussian_filter1d(rng.standard_normal(n), sigma_frames, mode="wrap")
    return np.asarray(noise / noise.std())


def write_corridor(
    folder: Path | str, *, n_modules: int = 5, n_laps: int = 2, seed: int = 0, progress: Progress | None = None
) -> Path:
    """Fly through the corridor and write ``seq-01/frame-NNNNNN.{color.png,pose.txt}``, intrinsics and frame rate.

    The seed is that of world, path and camera noise. Returns the folder of the recording.
    """
    world = CorridorWorld(n_modules, seed=seed)
    poses = drone_path(world, n_laps, seed).poses_se3
    return write_flight(Path(folder) / "seq-01", Renderer(world), poses, noise_seed=seed * 1_000_003, progress=progress)


def write_passes(
    folder: Path | str,
    *,
    n_modules: int = 3,
    n_passes: int = 4,
    seed: int = 0,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Fly passes through the corridor, each a recording of its own, ``seq-01`` and so on: they are exchangeable.

    The seed is that of world, paths and camera noise. Returns the folder of the recordings. Those that are there are
    not flown again.
    """
    world, folder = CorridorWorld(n_modules, seed=seed), Path(folder)
    renderer, done = Renderer(world), 0
    passes = [drone_pass(world, (seed, number), speed).poses_se3 for number in range(n_passes)]
    total = sum(map(len, passes))
    for number, poses in enumerate(passes):
        report = None if progress is None else partial(_report, progress, done, total)
        noise_seed = ((seed + 1) * 1_000 + number) * 1_000_003
        recording = folder / f"seq-{number + 1:02d}"
        if not recording.is_dir():
            write_flight(recording, renderer, poses, noise_seed=noise_seed, progress=report)
        done += len(poses)
    return folder


def _report(progress: Progress, before: int, total: int, done: int, _: int) -> None:
    progress(before + done, total)


def write_flight(
    recording: Path, renderer: Renderer, poses_se3: FloatArray, *, noise_seed: int = 0, progress: Progress | None = None
) -> Path:
    """Write what the camera sees from `poses_se3` (n, 4, 4) ``T_world_cam`` as a recording; returns its folder.

    Intrinsics and frame rate are written into the folder above, which may hold many recordings. Frame i has camera
    noise of seed ``noise_seed + i``.
    """
    with staged(recording) as part:
        for i, pose in enumerate(poses_se3):
            image = Image.fromarray(renderer.render(pose, noise_seed=noise_seed + i))
            image.save(part / f"frame-{i:06d}.color.png", compress_level=1)
            np.savetxt(part / f"frame-{i:06d}.pose.txt", pose, fmt="%.12e")
            if progress is not None:
                progress(i + 1, len(poses_se3))
        np.savetxt(recording.parent / "camera-intrinsics.txt", renderer.camera.matrix)
        (recording.parent / "frame-rate.txt").write_text(f"{FRAME_RATE_HZ:g}\n", encoding="utf-8")
    return recording
