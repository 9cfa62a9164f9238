"""What a reader returns: frames as they are in the files; and the recording of those that can be used.

A frame that cannot be used is left out and told; the others keep their times and poses.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera, Trajectory, poses_at
from conformodal.geometry.lens import AnyCamera, pinhole_of
from conformodal.geometry.metrics import MAX_GAP_S, clock_hint, in_seconds, nearest_in_time

from .cameras import uncalibrated_camera
from .decoding import TURNED, WIDEST, common_size, image_fault, is_turned, sample_wide, white_level
from .errors import DatasetError, DatasetWarning
from .lenses import undistort_to
from .pose_files import PoseRows
from .reading import Note, by_what, read_numbers, readable, shown
from .recording import Recording

Damaged = dict[int, str]

NO_POSE = "no pose"
INTERPOLATED, CONVERTED = "poses are interpolated", "times are converted to seconds"
SCALED_BITS, FLAT = "images use fewer than 16 bits", "images have little contrast"
DOUBTFUL, _UNUSABLE = "poses are doubtful", "pose cannot be used"
_USUAL_STEP_S, _FASTEST_MPS = (5e-4, 5.0), 150.0
_LEFT_OUT = "left out, "
_LEAST_CONTRAST = 1 / 8
_SAME_S = 1e-3


@dataclass(eq=False)
class FrameTable:
    """Frames as a reader finds them.

    Attributes
    ----------
    name
        Of the data set.
    images
        One file per frame, in order.
    times
        (n,) seconds; NaN where it is damaged.
    camera
        Of all images, or a list with that of each; None where nothing says it.
    poses
        (n, 7) rows ``x y z qw qx qy qz`` of camera to world, NaN where there is none; None for a data set without.
    recording
        (n,) numbers; None for one recording.
    given_test
        (n,) whether the data set's own lists name a frame for testing; None if it has no lists.
    why
        Why a frame has no pose, where more is known than that it is missing.
    notes
        What was wrong or unusual so far.
    root
        The folder in which images must lie; None where their names come from listing it.
    source
        The file that names images, or where poses or a camera were looked for, for messages.
    as_stored
        Whether poses and cameras are of images as they are stored, whatever EXIF says of their orientation.
    """

    name: str
    images: list[Path]
    times: FloatArray
    camera: AnyCamera | list[AnyCamera] | None
    poses: FloatArray | None = None
    recording: IntArray | None = None
    given_test: BoolArray | None = None
    why: Damaged = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    root: Path | None = None
    source: Path | str = ""
    as_stored: bool = False

    def to_recording(
        self, *, require_poses: bool = True, follow_outside: bool = False, focal: float | Literal["auto"] | None = None
    ) -> Recording:
        """The frames that can be used, as the camera of most has them; warns of the others.

        Frames without a time in order, or with a name that is not text, are left out. With `require_poses`, so are
        those without a pose or an image. See :func:`~conformodal.io.read_recording` for the other parameters.
        """
        if require_poses and self.poses is None:
            raise DatasetError(f"{self.source or self.name}: poses are missing")
        if self.root is not None and not follow_outside:
            _refuse_outside(self.images, self.root, self.source)
        self.times = _in_seconds(self.times, self.name, self.notes)
        camera = self._one_camera(focal)
        out = self._without_time()
        posed = np.zeros(len(self.images), dtype=np.bool_)
        if self.poses is not None:
            posed |= np.isfinite(self.poses).all(axis=1)
        missing = [] if self.poses is None else np.flatnonzero(~posed).tolist()
        lacking = {i: f"{self.images[i].name}: {self.why.get(i, 'has no pose')}" for i in missing}
        if require_poses:
            out |= {i: Note(_LEFT_OUT + NO_POSE, why) for i, why in lacking.items() if i not in out}
            for i in (i for i in range(len(self.images)) if i not in out):
                if fault := image_fault(self.images[i], (camera.width, camera.height)):
                    out[i] = Note(_LEFT_OUT + "image cannot be read", fault)
        kept = np.array([i for i in range(len(self.images)) if i not in out], dtype=np.int64)
        if not kept.size:
            first = out[min(out)].where if out else f"{self.name}: holds no frame"
            raise DatasetError(f"{first} ({len(out)} of {len(self.images)} frames cannot be used)")
        with_pose = kept[posed[kept]]
        notes = [*self.notes, *(out[i] for i in sorted(out)), *self._unlikely(kept, with_pose)]
        if not require_poses and with_pose.size:
            notes += [Note(NO_POSE, lacking[i]) for i in kept.tolist() if i in lacking]
        for what, places in by_what(notes).items():
            warnings.warn(f"{self.name}: {len(places)} x {what}: {places[0]}", DatasetWarning, stacklevel=3)
        poses = None
        if self.poses is not None and with_pose.size:
            poses = Trajectory(self.times[with_pose], self.poses[with_pose, :3], self.poses[with_pose, 3:])
        return Recording(
            name=self.name,
            image_paths=tuple(self.images[i] for i in kept),
            timestamps_s=self.times[kept],
            recording=np.zeros(len(kept), dtype=np.int64) if self.recording is None else self.recording[kept],
            camera=camera,
            poses=poses,
            given_test=None if self.given_test is None else self.given_test[kept],
            notes=tuple(notes),
        )

    def _one_camera(self, focal: float | Literal["auto"] | None) -> PinholeCamera:
        """The camera of most frames; images of others, of a fisheye lens or of 16 bits become its."""
        if self.camera is None:
            self.camera = uncalibrated_camera(self.source, common_size(self.images), focal, self.notes)
        elif focal is not None:
            raise DatasetError(f"{self.name}: has a camera, and a focal length is for data sets without one")
        cameras = self.camera if isinstance(self.camera, list) else [self.camera] * len(self.images)
        (most, _), *others = Counter(cameras).most_common()
        camera = pinhole_of(most)
        if turned := [path for path in self.images if is_turned(path)]:
            if self.as_stored:
                raise DatasetError(
                    f"{turned[0]}: EXIF turns it, and poses and cameras in {self.source} are of images as they are "
                    "stored; remove the EXIF orientation (exiftool -Orientation= FILES)"
                )
            self.notes.append(
                Note(TURNED, f"{turned[0]}: as its EXIF orientation says; intrinsics must be those after")
            )
        white = self._white_level()
        if others or most != camera or white is not None:
            self.images = undistort_to(self.images, cameras, camera, white, self.notes)
        return camera

    def _white_level(self) -> int | None:
        """The level that is shown as white in images of 16 bits, None for 8; told where it is not that of all bits."""
        samples = sample_wide(self.images)
        if not samples:
            return None
        white = max(map(white_level, samples))
        if white < WIDEST:
            self.notes.append(Note(SCALED_BITS, f"{self.images[0]}: {white} of {WIDEST} is shown as white"))
        low, high = np.percentile(np.concatenate([wide.ravel() for wide in samples]), (0.5, 99.5))
        if high - low < _LEAST_CONTRAST * white:
            where = f"{self.images[0]}: 99 % of the numbers lie between {low:.0f} and {high:.0f} of {white}"
            self.notes.append(Note(FLAT, f"{where}; stretch them to 8 bits, all images alike"))
        return white

    def _unlikely(self, kept: IntArray, posed: IntArray) -> list[Note]:
        """Doubts about the units of times and positions."""
        same = np.ones(len(kept) - 1, dtype=np.bool_) if self.recording is None else np.diff(self.recording[kept]) == 0
        usual = float(np.median(np.diff(self.times[kept])[same])) if same.any() else 1.0
        notes = []
        if not _USUAL_STEP_S[0] <= usual <= _USUAL_STEP_S[1]:
            where = f"{self.name}: frames are {usual:.3g} s apart; are their times in another unit than seconds?"
            notes.append(Note("frame rate is unlikely", where))
        if self.poses is not None and len(posed) > 1:
            steps = np.linalg.norm(np.diff(self.poses[posed, :3], axis=0), axis=1)
            speed = float(np.median(steps / np.diff(self.times[posed])))
            if speed > _FASTEST_MPS:
                where = f"{self.name}: the camera moves at {speed:.3g} m/s; are positions in metres, times in seconds?"
                notes.append(Note("speed is unlikely", where))
        return notes

    def _without_time(self) -> dict[int, Note]:
        """Frames that can be used in no way."""
        out = {
            i: Note(_LEFT_OUT + "name is not UTF-8", shown(f"{path.name}: its name is not UTF-8; rename it"))
            for i, path in enumerate(self.images)
            if not readable(str(path))
        }
        for i in np.flatnonzero(~np.isfinite(self.times)).tolist():
            out.setdefault(i, Note(_LEFT_OUT + "no time", f"{self.images[i].name}: its time is {self.times[i]}"))
        timed = np.array([i for i in range(len(self.images)) if i not in out], dtype=np.int64)
        back = timed[_out_of_order(self.times[timed])]
        if back.size * 2 > timed.size:
            what = f"frame {back[0]} ({self.images[back[0]]}) goes back, or has the time of the one before"
            raise DatasetError(f"{self.name}: timestamps must increase; {what}: {self.times[back[0]]:.9g} s")
        for i in back.tolist():
            what = f"{self.images[i].name}: its time, {self.times[i]:.9g} s, does not lie between its neighbours'"
            out[i] = Note(_LEFT_OUT + "time goes back or occurs twice", what)
        return out


def _refuse_outside(images: list[Path], root: Path, source: Path | str) -> None:
    """Refuse names that lead out of a folder, as absolute paths or by ``..``.

    Links are followed: they are the choice of whoever keeps the folder, not of the list that names images.
    """
    real_root = os.path.realpath(root)
    for path in images:
        leads_out = ".." in path.parts or not path.is_relative_to(root)
        if leads_out and not Path(os.path.realpath(path)).is_relative_to(real_root):
            raise DatasetError(
                f"{source}: names {path}, which lies outside {root}; link it into the folder, or let it be followed "
                "with follow_outside (--follow-outside on the command line)"
            )


def _in_seconds(times: FloatArray, source: str, notes: list[Note]) -> FloatArray:
    """Times in seconds, with a note where they were not."""
    seconds, unit = in_seconds(times)
    if unit:
        notes.append(Note(CONVERTED, f"{source}: {np.nanmedian(times):.6g} looks like {unit}"))
    return seconds


def _out_of_order(times: FloatArray) -> IntArray:
    """Indices of times that must go so that the others increase strictly: those behind, or a single one far ahead."""
    kept: list[int] = []
    out: list[int] = []
    for i, time in enumerate(times.tolist()):
        if not kept or time > times[kept[-1]]:
            kept.append(i)
            continue
        next_is_behind = i + 1 < len(times) and times[i + 1] <= times[kept[-1]]
        if next_is_behind and time < times[i + 1] and (len(kept) < 2 or times[kept[-2]] < time):
            out.append(kept.pop())
            kept.append(i)
        else:
            out.append(i)
    return np.array(sorted(out), dtype=np.int64)


def paired_by_time(
    read: Callable[[Path], PoseRows], path: Path, times: FloatArray, notes: list[Note]
) -> tuple[FloatArray, Damaged]:
    """Poses (n, 7) of frames at `times`, interpolated by time, NaN where there is none; and why there is none.

    `read` gives the file's rows ``time x y z qw qx qy qz``. A frame at the time of a damaged row has no pose. A file
    ``max-gap.txt`` beside it holds the longest gap between two poses that is bridged, in seconds, instead of 0.15.
    """
    times, _ = in_seconds(times)  # of which the table tells
    table = read(path)
    faults = [table.damaged[i] for i in sorted(table.damaged)]
    rows = table.rows[np.isfinite(table.rows[:, 0])]
    rows[:, 0] = _in_seconds(rows[:, 0], str(path), notes)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    twice = np.flatnonzero((np.diff(rows[:, 0]) == 0) & (np.diff(rows, axis=0) != 0).any(axis=1))
    for t in np.unique(rows[twice, 0]):
        faults.append(f"{path}: holds two poses for time {t:.9g}")
        rows[rows[:, 0] == t, 1:] = np.nan
    notes += [*(Note(_UNUSABLE, fault) for fault in faults), *(Note(DOUBTFUL, doubt) for doubt in table.doubts)]
    sound = np.isfinite(rows).all(axis=1)
    truth = Trajectory(rows[sound, 0], rows[sound, 1:4], rows[sound, 4:])
    poses, asked = np.full((len(times), 7), np.nan), np.flatnonzero(np.isfinite(times))
    limit = path.with_name("max-gap.txt")
    max_gap_s = float(read_numbers(limit)[0]) if limit.is_file() else MAX_GAP_S
    poses[asked], gaps = poses_at(truth, times[asked], max_gap_s)
    if not sound.all() and len(asked):
        lost = rows[~sound, 0]
        poses[asked[np.abs(lost[nearest_in_time(lost, times[asked])] - times[asked]) < _SAME_S]] = np.nan
    if not np.isfinite(poses).any():
        hint = clock_hint(times[asked], truth.timestamps_s) if len(asked) and len(truth) else ""
        hint = hint or f"; or their gaps are longer: write a longer one into {limit.name}"
        some = f"; {counted(int((~sound).sum()), 'pose')} cannot be used: {faults[0]}" if faults else ""
        raise DatasetError(f"{path}: no image has a pose, or two within {max_gap_s:g} s around it, by time{hint}{some}")
    bridged = gaps[np.isfinite(poses[asked]).all(axis=1)]
    if bridged.max() > 0:
        count = counted(int((bridged > 0).sum()), "pose")
        where = f"{path}: {count} between its own; the largest gap bridged is {bridged.max():.3g} s"
        notes.append(Note(INTERPOLATED, where))
    why = {}
    for i, gap in zip(asked.tolist(), gaps.tolist(), strict=True):
        around = f"those around it are {gap:.3g} s apart" if np.isfinite(gap) else "it is outside of their times"
        why[i] = f"no pose within 1 ms in {path}, and {around}"
    return poses, why
