"""Writing a source in another layout."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from conformodal.core.words import counted
from conformodal.poses import PinholeCamera, PoseError, Trajectory, associate, concatenate, tum_lines, write_kitti

from .errors import DatasetError
from .files import MAX_TIME_DIFFERENCE_S, staged
from .layouts import Layout
from .nerf import FILE, OPENGL_AXES
from .streams import Frame, FrameStream, SequenceStream

# Where images go, and how they are named: number, or time in seconds.
_PLACES: dict[Layout, tuple[str, str]] = {
    Layout.SEVENSCENES: ("", "frame-{number:06d}.color"),
    Layout.TUM: ("rgb", "{time_s:.6f}"),
    Layout.KITTI: ("image_2", "{number:06d}"),
    Layout.IMAGES: ("", "{number:06d}"),
    Layout.NERF: ("images", "{number:06d}"),
}
WRITABLE = tuple(_PLACES)
_UNEVEN = 0.2
_MOST_NAMES = 20


@dataclass
class Written:
    """What was written, and what was not; the notes name the frames that were left out."""

    n_frames: int = 0
    n_unreadable: int = 0
    n_without_pose: int = 0
    n_without_time: int = 0
    notes: list[str] = field(default_factory=list)


def write_layout(
    folder: Path,
    layout: Layout,
    stream: FrameStream,
    camera: PinholeCamera,
    poses: Trajectory | None,
    progress: Callable[[int], None] | None = None,
    max_difference_s: float = MAX_TIME_DIFFERENCE_S,
) -> Written:
    """Write the frames of a source, one after the other; images that lie in files are copied as they are.

    They are written beside the folder and moved into its place at the end: a failure leaves nothing there.

    Parameters
    ----------
    folder
        New or empty.
    layout
        One of :data:`WRITABLE`.
    stream
        Of one recording.
    camera
        Intrinsics.
    poses
        Of the frames, paired by time; frames without one are left out. None writes no poses.
    progress
        Called with frames done.
    max_difference_s
        Between a frame and its pose; 0 for poses with the frames' own times.

    Raises
    ------
    DatasetError
        If the folder holds something, the layout cannot be written or cannot say such a lens, there are several
        recordings, a name would be used twice, or nothing is left to write.
    """
    if layout not in _PLACES:
        raise DatasetError(f"layout {layout} is read only; can be written: {', '.join(WRITABLE)}")
    if camera.distortion and layout is Layout.KITTI:
        raise DatasetError("kitti has no place for the lens's distortion; write another layout")
    if poses is None and layout is Layout.NERF:
        raise DatasetError("nerf needs a pose for every frame")
    if isinstance(stream, SequenceStream):
        _check(stream, poses, max_difference_s)
    with staged(folder) as part:
        return _write(part, layout, stream, camera, poses, progress, max_difference_s)


def _check(stream: SequenceStream, poses: Trajectory | None, max_difference_s: float) -> None:
    """Refuse what is known before the first frame is read."""
    times = stream.sequence.timestamps_s
    if stream.sequence.recording.any():
        raise DatasetError(f"{stream.name}: holds several recordings; convert one at a time")
    if poses is not None:
        asked = Trajectory(times, np.zeros((len(times), 3)), np.tile([1.0, 0, 0, 0], (len(times), 1)))
        try:
            associate(asked, poses, max_difference_s)
        except PoseError as exc:
            raise DatasetError(f"{stream.name}: no frame has a pose: {exc}") from exc


def _write(
    folder: Path,
    layout: Layout,
    stream: FrameStream,
    camera: PinholeCamera,
    poses: Trajectory | None,
    progress: Callable[[int], None] | None,
    max_difference_s: float,
) -> Written:
    place, pattern = folder / _PLACES[layout][0], _PLACES[layout][1]
    place.mkdir(parents=True, exist_ok=True)
    done = Written()
    names: list[str] = []
    times: list[float] = []
    kept: list[Trajectory] = []
    left: dict[str, list[str]] = {"without a pose": [], "without an image": [], "whose time goes back": []}
    for number, frame in enumerate(stream, start=1):
        if frame.recording:
            raise DatasetError(f"{stream.name}: holds several recordings; convert one at a time")
        pose = None if poses is None else _pose(poses, frame.timestamp_s, max_difference_s)
        if frame.image is None or frame.image.shape[:2] != (camera.height, camera.width):
            left["without an image"].append(frame.name)
        elif not np.isfinite(frame.timestamp_s) or (times and frame.timestamp_s <= times[-1]):
            left["whose time goes back"].append(frame.name)
        elif poses is not None and pose is None:
            left["without a pose"].append(frame.name)
        else:
            name = _image(place, pattern.format(number=len(names), time_s=frame.timestamp_s), frame, stream)
            names.append(name)
            times.append(frame.timestamp_s)
            if pose is not None:
                kept.append(pose)
        if progress is not None:
            progress(number)
    done.n_without_pose, done.n_unreadable, done.n_without_time = (len(frames) for frames in left.values())
    if not names:
        raise DatasetError(f"{stream.name}: nothing to write: {done.n_unreadable} unreadable, no pose for the rest")
    for why, frames in left.items():
        if frames:
            more = f" and {len(frames) - _MOST_NAMES} more" if len(frames) > _MOST_NAMES else ""
            done.notes.append(
                f"left out {counted(len(frames), 'frame')} {why}: {', '.join(frames[:_MOST_NAMES])}{more}"
            )
    done.n_frames = len(names)
    stamps = np.array(times)
    found = None
    if kept:
        joined = concatenate(kept)
        found = Trajectory(stamps, joined.positions_xyz, joined.orientations_quat_wxyz)
    _finish(folder, layout, names, stamps, camera, found, done)
    return done


def _pose(poses: Trajectory, time_s: float, max_difference_s: float) -> Trajectory | None:
    if not np.isfinite(time_s):
        return None
    asked = Trajectory(np.array([time_s]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]))
    try:
        _, at = associate(asked, poses, max_difference_s)
    except PoseError:
        return None
    return poses[at]


def _image(place: Path, stem: str, frame: Frame, stream: FrameStream) -> str:
    source = stream.sequence.image_paths[frame.index] if isinstance(stream, SequenceStream) else None
    suffix = source.suffix if source is not None and source.suffix in (".png", ".jpg") else ".png"
    target = place / f"{stem}{suffix}"
    if target.exists():
        raise DatasetError(f"{target}: two frames have this name")
    if source is not None and source.suffix == suffix:
        shutil.copyfile(source, target)
    else:
        Image.fromarray(np.asarray(frame.image)).save(target)
    return target.name


def _finish(
    folder: Path,
    layout: Layout,
    names: list[str],
    times: npt.NDArray[np.float64],
    camera: PinholeCamera,
    truth: Trajectory | None,
    done: Written,
) -> None:
    """Everything but the images."""
    steps = np.diff(times)
    rate = 1 / float(np.median(steps)) if steps.size else 30.0
    if layout in (Layout.SEVENSCENES, Layout.NERF):
        np.savetxt(folder / "frame-rate.txt", [rate])
        if steps.size and np.abs(steps * rate - 1).max() > _UNEVEN:
            done.notes.append(f"{layout} has no timestamps: they are read back as even, {rate:.3f} Hz")
    if layout is Layout.NERF:
        assert truth is not None
        _nerf(folder, names, camera, truth)
        return
    if layout is Layout.KITTI:
        row = f"{camera.fx!r} 0 {camera.cx!r} 0 0 {camera.fy!r} {camera.cy!r} 0 0 0 1 0"
        (folder / "calib.txt").write_text("".join(f"P{k}: {row}\n" for k in range(4)), encoding="utf-8")
        np.savetxt(folder / "times.txt", times, fmt="%.9f")
        if truth is not None:
            write_kitti(folder / "poses.txt", truth)
        return
    np.savetxt(folder / "camera-intrinsics.txt", camera.matrix)
    if camera.distortion:
        np.savetxt(folder / "camera-distortion.txt", camera.distortion)
    if layout is Layout.SEVENSCENES and truth is not None:
        for name, pose in zip(names, truth.poses_se3, strict=True):
            np.savetxt(folder / f"{name.split('.')[0]}.pose.txt", pose, fmt="%.9e")
    if layout is Layout.IMAGES:
        np.savetxt(folder / "times.txt", times, fmt="%.9f")
    if layout is Layout.TUM:
        lines = [f"{time:.6f} rgb/{name}\n" for time, name in zip(times, names, strict=True)]
        (folder / "rgb.txt").write_text("".join(["# timestamp filename\n", *lines]), encoding="utf-8")
    if truth is not None and layout in (Layout.TUM, Layout.IMAGES):
        path = folder / ("groundtruth.txt" if layout is Layout.TUM else "poses.tum")
        path.write_text("\n".join(["# timestamp tx ty tz qx qy qz qw", *tum_lines(truth)]) + "\n", encoding="utf-8")


def _nerf(folder: Path, names: list[str], camera: PinholeCamera, truth: Trajectory) -> None:
    lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion, strict=False))
    poses = truth.poses_se3 @ OPENGL_AXES
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
        for name, pose in zip(names, poses, strict=True)
    ]
    content: dict[str, object] = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, **lens}
    content |= {"w": camera.width, "h": camera.height, "frames": frames}
    (folder / FILE).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
