"""Frames as a reader finds them, and the sequence of those that can be used.

A frame that cannot be used is left out and told; the others keep their times and poses.
"""

from __future__ import annotations

import re
import warnings
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from conformodal.core.arrays import BoolArray, FloatArray, IntArray
from conformodal.core.words import counted
from conformodal.geometry import PinholeCamera, PoseError, Trajectory, poses_at
from conformodal.geometry.metrics import MAX_GAP_S, clock_hint, in_seconds, nearest_in_time

from .decoding import FLAT, SCALED_BITS, TURNED, WIDEST, image_fault, looked_at, natural_key
from .errors import DatasetError, DatasetWarning
from .lenses import AnyCamera, Fisheye, brought
from .pose_text import TrajectoryFileError, is_header
from .reading import BETWEEN_RECORDINGS_S, Note, by_what, read_lines, read_numbers, readable, shown
from .recording import Recording

Damaged = dict[int, str]

NO_POSE = "no pose"
INTERPOLATED, CONVERTED = "poses are interpolated", "times are converted to seconds"
DOUBTFUL = "poses are doubtful"
_USUAL_STEP_S, _FASTEST_MPS = (5e-4, 5.0), 150.0
_LEFT_OUT = "left out, "
_LEAST_CONTRAST = 1 / 8


@dataclass(eq=False)
class FrameTable:
    """Frames as a reader finds them.

    Attributes
    ----------
    name
        Of the data set.
    images
        A file a frame, in order.
    times
        (n,) seconds; NaN where it is damaged.
    recording
        (n,) numbers; None for one recording.
    poses
        (n, 7) rows ``x y z qw qx qy qz`` of camera to world, NaN where there is none; None for a data set without.
    why
        Why a frame has no pose, where more is known than that it is missing.
    notes
        What was found wrong so far.
    """

    name: str
    images: list[Path]
    times: FloatArray
    recording: IntArray | None = None
    poses: FloatArray | None = None
    why: Damaged = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)

    def sequence(
        self, camera: AnyCamera | list[AnyCamera], *, require_poses: bool, given_test: BoolArray | None = None
    ) -> Recording:
        """The sequence of the frames that can be used, as the camera of most has them; warns of the others.

        Frames without a time in order, or with a name that is no text, are left out. With `require_poses`, so are
        those without a pose or an image.
        """
        self.times = _converted(self.times, self.name, self.notes)
        camera = self._one_camera(camera if isinstance(camera, list) else [camera] * len(self.images))
        out = self._without_time()
        posed = np.zeros(len(self.images), dtype=np.bool_)
        if self.poses is not None:
            posed |= np.isfinite(self.poses).all(axis=1)
        missing = [] if self.poses is None else np.flatnonzero(~posed).tolist()
        lacking = {i: f"{self.images[i].name}: {self.why.get(i, 'has no pose')}" for i in missing}
        if require_poses:
            out |= {i: Note(_LEFT_OUT + NO_POSE, why) for i, why in lacking.items() if i not in out}
            size = camera.width, camera.height
            for i in (i for i in range(len(self.images)) if i not in out):
                fault = image_fault(self.images[i], size)
                if fault:
                    out[i] = Note(_LEFT_OUT + "image cannot be read", fault)
        kept = np.array([i for i in range(len(self.images)) if i not in out], dtype=np.int64)
        if not kept.size:
            first = out[min(out)].where if out else f"{self.name}: holds no frame"
            raise DatasetError(f"{first} ({len(out)} of {len(self.images)} frames cannot be used)")
        notes = [*self.notes, *(out[i] for i in sorted(out)), *self._unlikely(kept, kept[posed[kept]])]
        if not require_poses and posed[kept].any():
            notes += [Note(NO_POSE, lacking[i]) for i in kept.tolist() if i in lacking]
        for what, places in by_what(notes).items():
            warnings.warn(f"{self.name}: {len(places)} x {what}: {places[0]}", DatasetWarning, stacklevel=4)
        recording = np.zeros(len(self.images), dtype=np.int64) if self.recording is None else self.recording
        with_pose = kept[posed[kept]]
        truth, whole = None, len(with_pose) == len(kept)
        if self.poses is not None and with_pose.size:
            truth = Trajectory(self.times[with_pose], self.poses[with_pose, :3], self.poses[with_pose, 3:])
        return Recording(
            name=self.name,
            image_paths=tuple(self.images[i] for i in kept),
            timestamps_s=self.times[kept],
            recording=recording[kept],
            camera=camera,
            truth=truth if whole else None,
            given_test=None if given_test is None else given_test[kept],
            known_poses=truth,
            notes=tuple(notes),
        )

    def _one_camera(self, cameras: list[AnyCamera]) -> PinholeCamera:
        """The camera of most frames; images of others, of a fisheye lens or of 16 bits become its."""
        (most, _), *others = Counter(cameras).most_common()
        camera = most.pinhole if isinstance(most, Fisheye) else most
        white, (low, high), turned = looked_at(self.images)
        if turned:
            self.notes.append(
                Note(TURNED, f"{turned[0]}: as its EXIF orientation says; intrinsics must be those after")
            )
        if white is not None and white < WIDEST:
            self.notes.append(Note(SCALED_BITS, f"{self.images[0]}: {white} of {WIDEST} is shown as white"))
        if white is not None and high - low < _LEAST_CONTRAST * white:
            where = f"{self.images[0]}: 99 % of the numbers lie between {low:.0f} and {high:.0f} of {white}"
            self.notes.append(Note(FLAT, f"{where}; stretch them to 8 bits, all images alike"))
        if others or most != camera or white is not None:
            self.images = brought(self.images, cameras, camera, white, self.notes)
        return camera

    def _unlikely(self, kept: IntArray, posed: IntArray) -> list[Note]:
        """Doubts about the units of times and positions."""
        same = np.ones(len(kept) - 1, dtype=np.bool_) if self.recording is None else np.diff(self.recording[kept]) == 0
        usual = float(np.median(np.diff(self.times[kept])[same])) if same.any() else 1.0
        found = []
        if not _USUAL_STEP_S[0] <= usual <= _USUAL_STEP_S[1]:
            where = f"{self.name}: frames are {usual:.3g} s apart; are their times in another unit than seconds?"
            found.append(Note("frame rate is unlikely", where))
        if self.poses is not None and len(posed) > 1:
            moved = np.linalg.norm(np.diff(self.poses[posed, :3], axis=0), axis=1)
            speed = float(np.median(moved / np.diff(self.times[posed])))
            if speed > _FASTEST_MPS:
                where = f"{self.name}: the camera moves at {speed:.3g} m/s; are positions in metres, times in seconds?"
                found.append(Note("speed is unlikely", where))
        return found

    def _without_time(self) -> dict[int, Note]:
        """Frames that can be used in no way."""
        out = {
            i: Note(_LEFT_OUT + "name is not UTF-8", shown(f"{path.name}: its name is not UTF-8; rename it"))
            for i, path in enumerate(self.images)
            if not readable(str(path))
        }
        for i in np.flatnonzero(~np.isfinite(self.times)).tolist():
            out.setdefault(i, Note(_LEFT_OUT + "no time", f"{self.images[i].name}: its time is {self.times[i]}"))
        left = np.array([i for i in range(len(self.images)) if i not in out], dtype=np.int64)
        back = np.setdiff1d(left, left[_longest_rise(self.times[left])])
        if back.size * 2 > left.size:
            i = int(left[np.flatnonzero(np.diff(self.times[left]) <= 0)[0] + 1])
            what = f"frame {i} ({self.images[i]}) goes back, or has the time of the one before"
            raise DatasetError(f"{self.name}: timestamps must increase; {what}: {self.times[i]:.9g} s")
        for i in back.tolist():
            what = f"{self.images[i].name}: its time, {self.times[i]:.9g} s, does not lie between its neighbours'"
            out[i] = Note(_LEFT_OUT + "time goes back or occurs twice", what)
        return out


def _converted(times: FloatArray, source: str, notes: list[Note]) -> FloatArray:
    """Times in seconds, with a note where they were not."""
    found, unit = in_seconds(times)
    if unit:
        notes.append(Note(CONVERTED, f"{source}: {np.nanmedian(times):.6g} looks like {unit}"))
    return found


def _longest_rise(times: FloatArray) -> IntArray:
    """Indices of the longest strictly increasing part of times; the first of equal ones."""
    if (np.diff(times) > 0).all():
        return np.arange(len(times))
    tops: list[float] = []
    ends: list[int] = []
    before = np.full(len(times), -1)
    for i, time in enumerate(times.tolist()):
        k = bisect_left(tops, time)
        before[i] = ends[k - 1] if k else -1
        if k == len(tops):
            tops.append(time)
            ends.append(i)
        elif time < tops[k]:
            tops[k], ends[k] = time, i
    rise = [ends[-1]]
    while before[rise[-1]] >= 0:
        rise.append(int(before[rise[-1]]))
    return np.array(rise[::-1])


def listed(
    path: Path, parse: Callable[[str], tuple[float, Path]], expected: str, notes: list[Note]
) -> tuple[list[Path], FloatArray]:
    """Images and times of a list with one a line; damaged lines are left out and told."""
    images: list[Path] = []
    stamps: list[float] = []
    faults: list[str] = []
    for number, line in enumerate(read_lines(path), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            stamp, image = parse(line.replace('"', ""))
        except DatasetError:
            raise
        except (ValueError, IndexError):
            if not images and not faults and is_header(line):
                continue
            faults.append(f"{path}, line {number}: expected {expected}, got {line[:80]!r}")
            continue
        stamps.append(stamp)
        images.append(image)
    if not images:
        raise DatasetError(faults[0] if faults else f"{path}: lists no image")
    notes += [Note(_LEFT_OUT + "line cannot be read", fault) for fault in faults]
    return images, np.array(stamps)


def paired_by_time(
    read: Callable[[Path, Damaged, list[str]], FloatArray], path: Path, times: FloatArray, notes: list[Note]
) -> tuple[FloatArray, Damaged]:
    """Poses (n, 7) of frames at `times`, interpolated by time, NaN where there is none; and why there is none.

    `read` gives the file's rows ``time x y z qw qx qy qz``, and adds damaged ones to its second argument and doubts to
    its third. A frame at the time of a damaged row has no pose. A file ``max-gap.txt`` beside it holds the longest gap
    between two poses that is bridged, in seconds, instead of 0.15.
    """
    times, _ = in_seconds(times)  # of which the table tells
    damaged: Damaged = {}
    doubts: list[str] = []
    try:
        rows = read(path, damaged, doubts)
        notes += [Note("pose cannot be used", damaged[i]) for i in sorted(damaged)]
        notes += [Note(DOUBTFUL, doubt) for doubt in doubts]
        rows = rows[np.isfinite(rows[:, 0])]
        rows[:, 0] = _converted(rows[:, 0], str(path), notes)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        twice = np.flatnonzero((np.diff(rows[:, 0]) == 0) & (np.diff(rows, axis=0) != 0).any(axis=1))
        for t in np.unique(rows[twice, 0]):
            notes.append(Note("pose cannot be used", f"{path}: holds two poses for time {t:.9g}"))
            rows[rows[:, 0] == t, 1:] = np.nan
        told = [note for note in notes if note.what == "pose cannot be used"]
        sound = np.isfinite(rows).all(axis=1)
        truth = Trajectory(rows[sound, 0], rows[sound, 1:4], rows[sound, 4:])
    except TrajectoryFileError:
        raise
    except PoseError as exc:
        raise DatasetError(f"{path}: {exc}") from exc
    found, asked = np.full((len(times), 7), np.nan), np.flatnonzero(np.isfinite(times))
    limit = path.with_name("max-gap.txt")
    max_gap_s = float(read_numbers(limit)[0]) if limit.is_file() else MAX_GAP_S
    found[asked], gaps = poses_at(truth, times[asked], max_gap_s)
    if len(rows) > sound.sum() and len(asked):
        lost = rows[~sound, 0]
        found[asked[np.abs(lost[nearest_in_time(lost, times[asked])] - times[asked]) < 1e-3]] = np.nan
    if not np.isfinite(found).any():
        hint = clock_hint(times[asked], truth.timestamps_s) if len(asked) and len(truth) else ""
        step_s = float(np.median(np.diff(truth.timestamps_s))) if len(truth) > 1 else 0.0
        if not hint and step_s > max_gap_s:
            hint = f"; its poses are {step_s:.3g} s apart: write a longer gap into {limit.name}"
        some = f"; {counted(int((~sound).sum()), 'pose')} cannot be used: {told[0].where}" if told else ""
        raise DatasetError(f"{path}: no image has a pose, or two within {max_gap_s:g} s around it, by time{hint}{some}")
    bridged = gaps[np.isfinite(found[asked]).all(axis=1)]
    if bridged.max() > 0:
        count = counted(int((bridged > 0).sum()), "pose")
        where = f"{path}: {count} between its own; the largest gap bridged is {bridged.max():.3g} s"
        notes.append(Note(INTERPOLATED, where))
    around = [
        f"those around it are {gap:.3g} s apart" if gap < np.inf else "it is outside of their times" for gap in gaps
    ]
    why = {int(i): f"no pose within 1 ms in {path}, and {text}" for i, text in zip(asked, around, strict=True)}
    return found, why


def rows_of(images: list[Path], n_rows: int, path: Path, what: str) -> IntArray:
    """Which line of a file is about which image: all in order, or the one whose number is the image's name."""
    numbers = numbers_of(images)
    if numbers is not None:
        if (np.diff(numbers) == 1).all() and n_rows == len(images):
            return np.arange(n_rows)
        if numbers.max() < n_rows:
            return numbers
    elif n_rows == len(images):
        return np.arange(n_rows)
    raise DatasetError(f"{path}: holds {n_rows} {what} {len(images)} images")


def numbers_of(images: list[Path]) -> IntArray | None:
    """The images' names, if each is a number."""
    stems = [image.stem for image in images]
    numbered = all(stem.isascii() and stem.isdigit() and len(stem) < 10 for stem in stems)
    return np.array([int(stem) for stem in stems], dtype=np.int64) if numbered else None


def numbered_frames(
    folder: Path, pattern: re.Pattern[str], digits: int, notes: list[Note] | None = None
) -> list[tuple[int, Path]]:
    """Numbers and paths of a folder's images, in order.

    The first group of the pattern is the number, the second the suffix. Of several files with one number, png files
    come first, and among them the name with the usual number of digits.
    """
    found: dict[int, Path] = {}
    matches = [m for path in folder.iterdir() if (m := pattern.fullmatch(path.name))]
    for match in sorted(matches, key=lambda m: (m[2].lower() != "png", len(m[1]) != digits, m[0])):
        path = folder / match[0]
        first = found.setdefault(int(match[1]), path)
        if first is not path and notes is not None:
            notes.append(Note("left out, another file has its number", f"{path}: {first.name} has its number"))
    return sorted(found.items())


def recording_folders(parent: Path, pattern: re.Pattern[str], name: str, notes: list[Note] | None) -> list[Path]:
    """Folders of recordings in natural order; `notes` takes up others that begin like them."""
    found = []
    start = name.partition("NN")[0]
    for path in sorted(parent.glob(f"{start}*"), key=lambda p: natural_key(p.name)):
        if path.is_dir() and pattern.fullmatch(path.name):
            found.append(path)
        elif path.is_dir() and notes is not None:
            kind = "scene" if start == "scene_" else "recording"
            notes.append(Note(f"left out, no {kind}", f"{path}: is not called {name}"))
    return found


def joined(recordings: list[list[tuple[int, Path]]], rate_hz: float) -> tuple[list[Path], FloatArray, IntArray]:
    """Images, times and recording numbers of numbered frames; each recording begins 10 s after the one before."""
    times: list[float] = []
    for frames in recordings:
        start = times[-1] + BETWEEN_RECORDINGS_S if times else 0.0
        times += [start + i / rate_hz for i, _ in frames]
    recording = np.repeat(np.arange(len(recordings)), np.array([len(frames) for frames in recordings], dtype=np.int64))
    return [path for frames in recordings for _, path in frames], np.array(times), recording
