"""From videos to a recording: all steps, in order."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.parallel import peak_memory_bytes
from conformodal.core.progress import StageProgress, stage_of
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera
from conformodal.io.diagnosis.order import diagnose
from conformodal.io.errors import DatasetError, DatasetWarning
from conformodal.io.folders import scratch_beside
from conformodal.io.reading import Note
from conformodal.io.registry import Layout, read_recording

from .clips import Clip, open_sources, write_clips
from .matching import VerifiedPair, match_keyframes, parallax_px, verified_pairs
from .registration import register_frames
from .settings import MapError, MapSettings, require_pycolmap
from .structure import pinhole, reconstruct
from .verdict import MapQuality, Reason, judge, measure_map
from .world import Placement, World, place_world
from .writing import IMAGES, write_record, write_recording

_MIN_KEYFRAMES = 3
_MIN_PARALLAX_PX, _WIDEST = 3.0, 90  # of this percentile of the pairs


@dataclass(frozen=True, eq=False)
class MapReport:
    """What became of videos.

    Attributes
    ----------
    quality
        What is measured of the map.
    reasons
        Why it is not to be trusted; empty where it is.
    world
        Its scale and axes.
    path_length
        Of all videos, in the world's unit.
    cameras
        As they are fitted.
    written
        Whether the recording is on disk.
    seconds, peak_bytes
        What it took: time, and most memory of the process.
    notes
        Frames that were left out, and what is unlikely or assumed of the videos and their cameras.
    """

    quality: MapQuality
    reasons: tuple[Reason, ...]
    world: World
    path_length: float
    cameras: tuple[PinholeCamera, ...]
    written: bool
    seconds: float
    peak_bytes: int
    notes: tuple[Note, ...]

    def record(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "map": self.quality.record(),
            "trusted": not self.reasons,
            "reasons": [reason._asdict() for reason in self.reasons],
            "unit": self.world.unit,
            "axes": self.world.axes,
            "path_length": round(self.path_length, 4),
            "residuals_m": [round(float(value), 6) for value in self.world.residuals_m],
            "cameras": [asdict(camera) for camera in self.cameras],
            "seconds": round(self.seconds, 1),
            "peak_gb": round(self.peak_bytes / 1e9, 3),
        }


def build_map(
    videos: Sequence[Path],
    out: Path,
    *,
    placement: Placement | None = None,
    camera_file: Path | None = None,
    settings: MapSettings | None = None,
    record: Mapping[str, Any] | None = None,
    report: StageProgress | None = None,
) -> MapReport:
    """Map videos and folders of images without poses, and write a recording that can be trained on.

    A failure, or a map that is not to be trusted, leaves nothing on disk.

    Parameters
    ----------
    videos
        Files of videos, ROS recordings, or folders of images; of one place.
    out
        Folder to write, new or empty.
    placement
        What is known of scale and axes.
    camera_file
        ``camera-intrinsics.txt`` of the videos, or its folder, if they are calibrated; else cameras are fitted.
    settings
        How the map is made, and whether one that is not to be trusted is written.
    record
        What ``map.json`` says besides the result.
    report
        Called with the stage, and how much of it is done.

    Raises
    ------
    MapError
        If no map can be made, or scale or axes cannot be found.
    DatasetError
        If a video cannot be read, or `out` is not empty.
    """
    started = time.perf_counter()
    require_pycolmap()
    placement, settings = placement or Placement(), settings or MapSettings()
    placement.check()
    sources = open_sources(videos, camera_file)
    with scratch_beside(out) as part:
        work = part.parent / "work"
        work.mkdir()
        clips = write_clips(sources, part / IMAGES, settings, stage_of(report, "frames"))
        placement.frames(clips)  # names that are wrong are refused before the long work
        made = _make(clips, part, work, settings, placement, report)
        result = MapReport(
            quality=made.quality,
            reasons=made.reasons,
            world=made.world,
            path_length=made.path_length,
            cameras=made.cameras,
            written=settings.trust_map or not made.reasons,
            seconds=time.perf_counter() - started,
            peak_bytes=peak_memory_bytes(),
            # a file of a camera is read once per video
            notes=tuple(dict.fromkeys(note for clip in clips for note in clip.notes)),
        )
        if result.written:
            write_record(part, {**(record or {}), **result.record()})
            part.replace(out.resolve())
    return result


class _Made(NamedTuple):
    quality: MapQuality
    reasons: tuple[Reason, ...]
    world: World
    path_length: float
    cameras: tuple[PinholeCamera, ...]


def _make(
    clips: Sequence[Clip],
    folder: Path,
    work: Path,
    settings: MapSettings,
    placement: Placement,
    report: StageProgress | None,
) -> _Made:
    """Map clips whose frames lie in a folder, and complete the recording there."""
    images = folder / IMAGES
    _check_keyframes(clips)
    matched = match_keyframes(clips, images, work / "matches.db", settings, report)
    pairs = verified_pairs(matched, settings.min_matches)
    _check_parallax(clips, pairs)
    structure = reconstruct(matched, work, settings, report)
    poses = register_frames(clips, images, structure, stage_of(report, "between"))
    quality = measure_map(clips, structure, poses, pairs)
    world = place_world(poses, clips, placement, structure.depth)
    write_recording(folder, clips, structure, poses, world)
    reasons = judge(quality) or _diagnosed(folder)
    cameras = tuple(pinhole(camera) for camera in structure.model.cameras.values())
    path_length = world.similarity.scale * sum(_path_length(clip, poses) for clip in clips)
    return _Made(quality, tuple(reasons), world, path_length, cameras)


def _path_length(clip: Clip, poses: Mapping[str, FloatArray]) -> float:
    """Length of a clip's path in the map, over frames without a pose."""
    positions = np.array([poses[image][:3, 3] for image in clip.images if image in poses]).reshape(-1, 3)
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def _check_keyframes(clips: Sequence[Clip]) -> None:
    n_keyframes = sum(len(clip.keyframes) for clip in clips)
    if n_keyframes < _MIN_KEYFRAMES:
        n_frames, names = sum(map(len, clips)), ", ".join(clip.source for clip in clips)
        found = f"{counted(n_frames, 'frame')} with {counted(n_keyframes, 'different view')}"
        raise MapError(f"{names}: {found}, expected {_MIN_KEYFRAMES} or more views; move the camera, in the light")


def _check_parallax(clips: Sequence[Clip], pairs: Sequence[VerifiedPair]) -> None:
    """Refuse images that a camera which only turns would have taken."""
    names = ", ".join(clip.source for clip in clips)
    if not pairs:
        raise MapError(f"{names}: no two keyframes show the same; record more slowly, and what has texture")
    parallax = parallax_px(pairs, {image: clip.size for clip in clips for image in clip.keyframe_images})
    seen = float(np.percentile(parallax, _WIDEST))
    if seen < _MIN_PARALLAX_PX:
        found = f"no parallax: a camera that only turns explains the matches within {seen:.1f} px"
        raise MapError(
            f"{names}: {found}, expected {_MIN_PARALLAX_PX:g}; move the camera sideways, do not only turn it"
        )


def _diagnosed(folder: Path) -> list[Reason]:
    """What training would find wrong with the recording that was written."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DatasetWarning)
        try:
            cause = diagnose(read_recording(folder, Layout.COLMAP))
        except DatasetError as exc:
            return [Reason(f"the recording cannot be read: {exc}", "record again")]
    return [] if cause is None else [Reason(f"{cause.what} ({cause.evidence})", "record more slowly")]
