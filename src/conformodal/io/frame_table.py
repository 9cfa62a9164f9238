"""What a reader returns: frames as they are in the files; and the recording of those that can be used.

A frame that cannot be used is left out and told; the others keep their times and poses.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.core.words import as_utf8, counted
from conformodal.geometry import PinholeCamera, Trajectory, poses_at
from conformodal.geometry.metrics import MAX_GAP_S, nearest_in_time
from conformodal.geometry.poses import matrices_of, table_of

from .cameras import INTRINSICS, uncalibrated_camera, undistort_to
from .decoding import TURNED, common_size, image_fault, is_turned, refuse_few_bits
from .diagnosis.clocks import clock_hint, doubt_rate, in_seconds
from .diagnosis.stale import STALE_PICTURES, STALE_POSES, describe_stretches, stale_pictures, stale_poses
from .errors import DatasetError, DatasetWarning
from .pose_files import Faults, PoseRows
from .reading import BETWEEN_RECORDINGS_S, Note, group_by_kind, read_numbers
from .recording import Recording

NO_POSE = "no pose"
LEFT_OUT_STALE = "left out, repeats to the last bit"
OWN_SCALE, METRES_PER_UNIT = "the scale is its own", "metres-per-unit.txt"
INTERPOLATED, CONVERTED = "poses are interpolated", "times are converted to seconds"
DOUBTFUL, _UNUSABLE = "poses are doubtful", "pose cannot be used"
_FASTEST_MPS = 150.0
_SAME_S = 1e-3


@dataclass(eq=False)
class FrameTable:
    """Frames as a reader finds them."""

    name: str
    images: list[Path]  # one file per frame, in order
    times: FloatArray  # (n,) seconds
    camera: PinholeCamera | list[PinholeCamera] | None  # of all images, or of each; None where nothing says it
    poses: FloatArray | None = None  # (n, 7) ``x y z qw qx qy qz``, camera to world, NaN where there is none
    recording: IntArray | None = None  # (n,) numbers; None for one recording
    given_test: BoolArray | None = None  # (n,) whether the data set's own lists name a frame for testing
    why: Faults = field(default_factory=dict)  # why a frame has no pose, where more is known than that it is missing
    notes: list[Note] = field(default_factory=list)  # what was wrong or unusual so far
    root: Path | None = None  # the folder in which images must lie; None where their names come from listing it
    # the file that names images, or where poses or a camera were looked for, for messages
    source: Path | str = ""
    as_stored: bool = False  # whether poses and cameras are of images as stored, whatever EXIF says
    unit: str = "m"  # of positions: metres, or units of the data's own
    stale: Faults = field(default_factory=dict)  # frames whose pose or picture repeats an earlier one, and why
    _looked_for_stale_poses: bool = False  # in a file with times of its own

    @classmethod
    def of_recordings(cls, name: str, recordings: list[list[tuple[int, Path]]], rate_hz: float) -> Self:
        """Numbered images of recordings in one; each recording begins 10 s after the one before."""
        times: list[float] = []
        for frames in recordings:
            start = times[-1] + BETWEEN_RECORDINGS_S if times else 0.0
            times += [start + i / rate_hz for i, _ in frames]
        numbers = np.repeat(np.arange(len(recordings)), np.array([len(frames) for frames in recordings], np.int64))
        images = [path for frames in recordings for _, path in frames]
        return cls(name, images, np.array(times), None, recording=numbers)

    def add_poses(self, read: Callable[[Path], PoseRows], path: Path, T_body_cam: FloatArray | None = None) -> None:
        """Poses interpolated by time, and none for a frame at the time of a damaged row.

        `read` gives the file's rows ``time x y z qw qx qy qz``, of the body that the camera stands on at `T_body_cam`.
        """
        times, _ = in_seconds(self.times)  # of which the recording tells
        table = read(path)
        self.notes += [Note(_UNUSABLE, fault) for fault in table.faults.values()]
        self.notes += [Note(DOUBTFUL, doubt) for doubt in table.doubts]
        rows = table.rows[np.argsort(table.rows[:, 0], kind="stable")]
        rows[:, 0], unit = in_seconds(rows[:, 0])
        if unit:
            self.notes.append(Note(CONVERTED, f"{path}: its times look like {unit}"))
        sound = np.isfinite(rows).all(axis=1)
        truth = Trajectory(rows[sound, 0], rows[sound, 1:4], rows[sound, 4:])
        twice = np.flatnonzero((np.diff(truth.timestamps_s) == 0) & (np.diff(rows[sound], axis=0) != 0).any(axis=1))
        if twice.size:
            raise DatasetError(f"{path}: holds two poses for time {truth.timestamps_s[twice[0]]:.9f} s; remove one")
        table_rows = rows[sound]
        stale = stale_poses(table_rows[:, 0], table_rows[:, 1:], times, self.images)
        held = np.zeros(len(truth), dtype=np.bool_)
        for first, last in stale:
            held[first + 1 : last + 1] = True
        if stale:
            self._tell_stale(STALE_POSES, describe_stretches(str(path), "pose", stale, table_rows[:, 0], len(truth)))
        truth = truth[np.flatnonzero(~held)]
        poses, gaps = poses_at(truth, times)
        if not sound.all():
            lost = rows[~sound, 0]
            poses[np.abs(lost[nearest_in_time(lost, times)] - times) < _SAME_S] = np.nan
        bridged = gaps[np.isfinite(poses).all(axis=1)]
        if not bridged.size:
            if stale:
                raise DatasetError(f"{self.notes[-1].what}: {self.notes[-1].where}")
            hint = clock_hint(times, truth.timestamps_s)
            where = f"within {MAX_GAP_S:g} s around it, by time{hint}; give poses at the images' times"
            raise DatasetError(f"{path}: no image has a pose, or two {where}")
        if bridged.max() > 0:
            count = counted(int((bridged > 0).sum()), "pose")
            where = f"{path}: {count} between its own; the largest gap bridged is {bridged.max():.3g} s"
            self.notes.append(Note(INTERPOLATED, where))
        self.poses = poses if T_body_cam is None else table_of(matrices_of(poses) @ T_body_cam)
        for i, gap in enumerate(gaps.tolist()):
            around = f"those around it are {gap:.3g} s apart" if np.isfinite(gap) else "it is outside of their times"
            self.why[i] = f"no pose within 1 ms in {path}, and {around}"
        for first, last in stale:  # up to the next pose that is not one of them
            begin_s, end_s = table_rows[first, 0], table_rows[min(last + 1, len(table_rows) - 1), 0]
            at = np.flatnonzero((times > begin_s) & (times < end_s) & ~np.isfinite(self.poses).all(axis=1))
            self.stale |= dict.fromkeys(at.tolist(), f"its pose in {path} repeats that at {begin_s:.6f} s")
        self._looked_for_stale_poses = True

    def scale_by(self, folder: Path) -> None:
        """Bring positions of another unit to metres by ``metres-per-unit.txt``; without it, they keep their own."""
        path = folder / METRES_PER_UNIT
        if not path.is_file():
            self.unit = "units"
            where = f"{self.source}: lengths are in units of its own; {path} scales them"
            self.notes.append(Note(OWN_SCALE, where))
            return
        scale = read_numbers(path)
        if self.poses is None or scale.size != 1 or not 0 < scale[0] < np.inf:
            raise DatasetError(f"{path}: holds {scale[:9].tolist()}, expected the metres of one unit of the poses")
        self.poses[:, :3] *= scale[0]

    def to_recording(
        self, *, require_poses: bool = True, focal: float | None = None, camera: PinholeCamera | None = None
    ) -> Recording:
        """The frames that can be used, as the camera of most has them; warns of the others.

        With `require_poses`, frames without a pose or a sound image are left out. See
        :func:`~conformodal.io.read_recording` for the other parameters.
        """
        if require_poses and self.poses is None:
            raise DatasetError(f"{self.source or self.name}: poses are missing")
        if not self.images:
            raise DatasetError(f"{self.source or self.name}: holds no frame")
        if bad := next((path for path in map(str, self.images) if as_utf8(path) != path), None):
            raise DatasetError(f"{as_utf8(bad)}: its name is not UTF-8; rename it")
        if self.root is not None:
            _refuse_outside(self.images, self.root, self.source)
        if twice := [path for path, n in Counter(map(os.path.normpath, self.images)).items() if n > 1]:
            raise DatasetError(f"{self.source}: names {twice[0]} twice, expected each image once")
        times, unit = in_seconds(self.times)
        if unit:
            self.notes.append(Note(CONVERTED, f"{self.name}: {np.nanmedian(self.times):.6g} looks like {unit}"))
        camera = self._one_camera(focal, camera)
        rows = np.full((len(times), 7), np.nan) if self.poses is None else self.poses.copy()
        if self.poses is not None:
            self._drop_stale(times, rows)
        posed = np.asarray(np.isfinite(rows).all(axis=1))
        unposed = [] if self.poses is None else np.flatnonzero(~posed).tolist()
        without = {i: f"{self.images[i].name}: {self.why.get(i, 'has no pose')}" for i in unposed}
        left_out = self._unusable(camera, without, posed) if require_poses else {}
        kept = np.array([i for i in range(len(times)) if i not in left_out], dtype=np.int64)
        if not kept.size:
            raise DatasetError(f"{left_out[0].where} ({len(left_out)} frames, and none can be used)")
        with_pose = kept[posed[kept]]
        notes = [*self.notes, *(left_out[i] for i in sorted(left_out))]
        if with_pose.size and not require_poses:
            notes += [Note(NO_POSE, why) for i, why in without.items() if i not in self.stale]
        recording = Recording(
            name=self.name,
            image_paths=tuple(self.images[i] for i in kept),
            timestamps_s=times[kept],
            recording=np.zeros(len(kept), dtype=np.int64) if self.recording is None else self.recording[kept],
            camera=camera,
            poses=Trajectory(times[with_pose], rows[with_pose, :3], rows[with_pose, 3:]) if with_pose.size else None,
            given_test=None if self.given_test is None else self.given_test[kept],
            unit=self.unit,
        )
        notes += _unlikely(recording)
        for what, places in group_by_kind(notes).items():
            warnings.warn(f"{self.name}: {len(places)} x {what}: {places[0]}", DatasetWarning, stacklevel=3)
        return replace(recording, notes=tuple(notes))

    def _unusable(self, camera: PinholeCamera, without: Faults, posed: BoolArray) -> dict[int, Note]:
        """Frames that are left out where poses are required: without a pose, a sound image, or new values."""
        left_out = {i: Note(f"left out, {NO_POSE}", why) for i, why in without.items()}
        left_out |= {i: Note(LEFT_OUT_STALE, f"{self.images[i].name}: {why}") for i, why in self.stale.items()}
        for i in np.flatnonzero(posed).tolist():
            if i not in left_out and (fault := image_fault(self.images[i], (camera.width, camera.height))):
                left_out[i] = Note("left out, image cannot be read", fault)
        return left_out

    def _drop_stale(self, times: FloatArray, rows: FloatArray) -> None:
        """Take poses (n, 7) away that repeat while the images move; find pictures that repeat while poses move."""
        if not self._looked_for_stale_poses:
            stale = stale_poses(times, rows, times, self.images, self.recording)
            for first, last in stale:
                rows[first + 1 : last + 1] = np.nan
                why = f"its pose repeats that of {self.images[first].name}"
                self.stale |= dict.fromkeys(range(first + 1, last + 1), why)
            if stale:
                where = describe_stretches(str(self.source or self.name), "pose", stale, times, len(rows))
                self._tell_stale(STALE_POSES, where)
        pictures = stale_pictures(self.images, times, rows, self.recording)
        for first, last in pictures:
            self.stale |= dict.fromkeys(
                range(first + 1, last + 1), f"it repeats the picture of {self.images[first].name}"
            )
        if pictures:
            self._tell_stale(STALE_PICTURES, describe_stretches(self.name, "picture", pictures, times, len(rows)))

    def _tell_stale(self, what: str, where: str) -> None:
        remedy = "the tracker lost the camera" if what == STALE_POSES else "the camera or its driver stopped"
        self.notes.append(Note(what, f"{where}; {remedy} there: train leaves these frames out"))

    def _one_camera(self, focal: float | None, given: PinholeCamera | None) -> PinholeCamera:
        """The camera of most frames; images of others are brought to it. That given is for those without one."""
        if self.camera is None and given is not None:
            if (size := common_size(self.images)) != (given.width, given.height):
                found = f"images have {size[0]}x{size[1]} pixels, and the camera has {given.width}x{given.height}"
                raise DatasetError(f"{self.source}: {found}; write the camera's 3x3 matrix into {INTRINSICS}")
            self.camera = given
        elif self.camera is None:
            self.camera = uncalibrated_camera(self.source, common_size(self.images), focal, self.notes)
        elif focal is not None:
            raise DatasetError(f"{self.name}: has a camera, and a focal length is for data sets without one")
        cameras = self.camera if isinstance(self.camera, list) else [self.camera] * len(self.images)
        most = Counter(cameras).most_common(1)[0][0]
        if turned := next((path for path in self.images if is_turned(path)), None):
            if self.as_stored:
                what = f"EXIF turns it, and {self.source} is of images as stored"
                raise DatasetError(f"{turned}: {what}; remove the orientation (exiftool -Orientation= FILES)")
            self.notes.append(Note(TURNED, f"{turned}: as its EXIF orientation says; intrinsics must be those after"))
        refuse_few_bits(self.images)
        if len(set(cameras)) > 1:
            self.images = undistort_to(self.images, cameras, most, self.notes)
        return most


def _unlikely(recording: Recording) -> list[Note]:
    """Doubts about the units of times and positions."""
    steps = np.diff(recording.timestamps_s)[np.diff(recording.recording) == 0]
    usual = float(np.median(steps)) if steps.size else 1.0
    notes = []
    if doubt := doubt_rate(usual):
        notes.append(Note("frame rate is unlikely", f"{recording.name}: {doubt}"))
    if recording.poses is not None and len(recording.poses) > 1:
        lengths = np.linalg.norm(np.diff(recording.poses.positions_xyz, axis=0), axis=1)
        speed = float(np.median(lengths / np.diff(recording.poses.timestamps_s)))
        if speed > _FASTEST_MPS:
            where = f"{recording.name}: the camera moves at {speed:.3g} m/s; are positions in metres, times in seconds?"
            notes.append(Note("speed is unlikely", where))
    return notes


def _refuse_outside(images: list[Path], root: Path, source: Path | str) -> None:
    """Refuse names that lead out of a folder, as absolute paths or by ``..``.

    Links are followed: they are the choice of whoever keeps the folder, not of the list that names images.
    """
    real_root = os.path.realpath(root)
    for path in images:
        leads_out = ".." in path.parts or not path.is_relative_to(root)
        if leads_out and not Path(os.path.realpath(path)).is_relative_to(real_root):
            raise DatasetError(f"{source}: names {path}, which lies outside {root}; link its folder into the data set")
