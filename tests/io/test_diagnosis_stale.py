"""Poses and pictures that repeat to the last bit, while the other side moves or rests."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, PngImagePlugin
from scipy.spatial.transform import Rotation

from conformodal.geometry import PinholeCamera
from conformodal.io import DatasetError, Layout, Recording, read_recording
from conformodal.io.diagnosis.stale import STALE_PICTURES, STALE_POSES, RepeatWatch
from conformodal.io.frame_table import NO_POSE
from conformodal.io.streams.frames import RecordingStream, prefetch
from tests.helpers import invoke

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")
N, RATE_HZ, SIZE, STEP_PX = 60, 30, (160, 120), 3
SCENE = np.repeat(np.repeat(np.random.default_rng(0).integers(0, 255, (40, 120, 3), np.uint8), 4, axis=0), 4, axis=1)
MOVING, RESTING = np.arange(N), np.zeros(N, dtype=int)


def held(*spans):
    """Places of frames, one after the other, that stay at the first of each span."""
    at = MOVING.copy()
    for first, last in spans:
        at[first : last + 1] = first
    return at


def picture(at, noise=None):
    image = SCENE[:, STEP_PX * at : STEP_PX * at + SIZE[0]][: SIZE[1]].astype(int)
    image = image if noise is None else image + np.random.default_rng(noise).integers(-2, 3, image.shape)
    return Image.fromarray(image.clip(0, 255).astype(np.uint8))


def row(at):
    """A pose of a path that turns; each has its own digits."""
    return 0.01 * at, np.sin(0.03 * at), 1.5, *Rotation.from_euler("y", 0.01 * at).as_quat()


def write(folder, pictures, poses, layout=Layout.TUM, suffix="png", per_frame=1, noisy=False, times=None, late_s=0.0):
    """A recording whose frames show and have the places of these numbers (n,)."""
    folder.mkdir(parents=True)
    times = np.arange(N) / RATE_HZ if times is None else times
    (folder / "camera-intrinsics.txt").write_text("150 0 80\n0 150 60\n0 0 1\n")
    for i, at in enumerate(pictures):
        name = f"frame-{i:06d}.color.{suffix}" if layout is Layout.SEVENSCENES else f"{i:06d}.{suffix}"
        note = PngImagePlugin.PngInfo()
        note.add_text("number", f"{i:06d}")  # files differ where pictures do not
        picture(at, i if noisy else None).save(folder / name, **({"pnginfo": note} if suffix == "png" else {}))
        if layout is Layout.SEVENSCENES:
            x, y, z, *quat = row(poses[i])
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = Rotation.from_quat(quat).as_matrix(), (x, y, z)
            np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    if layout is Layout.TUM:
        (folder / "rgb.txt").write_text("".join(f"{t:.6f} {i:06d}.{suffix}\n" for i, t in enumerate(times)))
        at = np.arange(0, N - 1 + 1e-9, 1 / per_frame)
        first = [poses[int(a)] if poses[int(a)] < int(a) or poses[min(int(a) + 1, N - 1)] == int(a) else a for a in at]
        lines = [(np.interp(a, MOVING, times) + late_s, row(place)) for a, place in zip(at, first, strict=True)]
        text = "".join(f"{t:.6f} {' '.join(f'{v:.9f}' for v in values)}\n" for t, values in lines)
        (folder / "groundtruth.txt").write_text(text)
    return folder


def told(recording):
    return {what: where for what, where in recording.notes if what in (STALE_POSES, STALE_PICTURES)}


HELD = held((10, 19), (40, 45))


@pytest.mark.parametrize("layout", [Layout.TUM, Layout.SEVENSCENES])
def test_stale_poses_are_named_and_left_out(tmp_path, layout):
    folder = write(tmp_path / "a", MOVING, HELD, layout)
    whole = read_recording(folder, require_poses=False)
    assert set(told(whole)) == {STALE_POSES}
    assert f"14 of {N} poses (23 %)" in told(whole)[STALE_POSES]
    assert "in 2 stretches: 0.3 s from 0.333, 0.167 s from 1.333" in told(whole)[STALE_POSES]
    assert not any(what == NO_POSE for what, _ in whole.notes)  # one cause is told
    stale = {*range(11, 20), *range(41, 46)}
    assert set(range(N)) - set(whole.posed.tolist()) == stale
    trained = read_recording(folder)
    assert len(trained) == N - len(stale)
    assert not {int(path.name.split(".")[0].removeprefix("frame-")) for path in trained.image_paths} & stale
    result = invoke("data", "check", folder)
    assert result.exit_code == 1
    assert f"1 x {STALE_POSES}" in result.output


def test_stale_rows_of_a_fast_tracker_give_no_poses(tmp_path):
    folder = write(tmp_path / "a", MOVING, HELD, per_frame=4)
    recording = read_recording(folder, require_poses=False)
    assert set(told(recording)) == {STALE_POSES}
    without = set(range(N)) - set(recording.posed.tolist())
    assert without == {*range(11, 20), *range(41, 46)}
    exact = np.array([row(i)[:3] for i in recording.posed])
    np.testing.assert_allclose(recording.poses.positions_xyz, exact, atol=1e-4)


@pytest.mark.parametrize("every", [2, 3])
def test_poses_of_a_lower_rate_that_are_held_are_named(tmp_path, every):
    recording = read_recording(write(tmp_path / "a", MOVING, MOVING // every * every, Layout.SEVENSCENES))
    assert set(told(recording)) == {STALE_POSES}
    assert len(recording) == N // every


def test_poses_that_never_move_are_refused_with_the_cause(tmp_path):
    with pytest.raises(DatasetError, match=f"{STALE_POSES}: .* {N - 1} of {N} poses"):
        read_recording(write(tmp_path / "a", MOVING, RESTING, late_s=0.01))


@pytest.mark.parametrize(
    ("pictures", "poses", "noisy"),
    [
        (MOVING, MOVING, False),
        (HELD, HELD, True),  # a camera that rests, of noise
        (HELD, HELD, False),  # a rendered one
        (MOVING, held((10, 11), (30, 31)), False),  # single repeats
        (held((10, 11), (30, 31)), MOVING, False),
    ],
)
@pytest.mark.parametrize("layout", [Layout.TUM, Layout.SEVENSCENES])
def test_a_camera_that_rests_and_single_repeats_are_sound(tmp_path, pictures, poses, noisy, layout):
    recording = read_recording(write(tmp_path / "a", pictures, poses, layout, noisy=noisy))
    assert told(recording) == {}
    assert len(recording) == N


@pytest.mark.parametrize("suffix", ["png", "bmp", "jpg"])
@pytest.mark.parametrize("layout", [Layout.TUM, Layout.SEVENSCENES])
def test_stale_pictures_are_named_and_left_out(tmp_path, suffix, layout):
    if layout is Layout.SEVENSCENES and suffix == "bmp":
        pytest.skip("is not of this layout")
    folder = write(tmp_path / "a", HELD, MOVING, layout, suffix)
    whole = read_recording(folder, require_poses=False)
    assert set(told(whole)) == {STALE_PICTURES}
    assert f"14 of {N} pictures (23 %)" in told(whole)[STALE_PICTURES]
    assert len(whole.posed) == N
    assert len(read_recording(folder)) == N - 14
    assert invoke("data", "check", folder).exit_code == 1


@pytest.mark.parametrize(("lost", "found"), [((10, 19), 14), ((*range(10, 19), 40, 41, 42, 43, 44), 0)])
def test_stale_pictures_are_found_without_some_poses(tmp_path, lost, found):
    folder = write(tmp_path / "a", HELD, MOVING, Layout.SEVENSCENES)
    for i in lost:
        (folder / f"frame-{i:06d}.pose.txt").unlink()
    where = told(read_recording(folder, require_poses=False)).get(STALE_PICTURES, "")
    assert where.startswith(f"{folder.name}: {found} of" if found else "")
    assert bool(where) == bool(found)


def test_a_single_repeat_that_lasts_is_named_and_a_gap(tmp_path):
    folder = write(tmp_path / "a", held((10, 11)), MOVING, times=np.arange(N) / 10)
    recording = read_recording(folder, require_poses=False)
    assert "0.1 s from 1.000" in told(recording)[STALE_PICTURES]
    frames = list(prefetch(RecordingStream(recording)))
    assert [i for i, frame in enumerate(frames) if frame.image is None] == [11]


def test_pictures_of_a_lower_rate_are_named(tmp_path):
    recording = read_recording(write(tmp_path / "a", MOVING // 2 * 2, MOVING))
    assert set(told(recording)) == {STALE_PICTURES}


def answered(pictures, tmp_path, noisy=False):
    recording = read_recording(write(tmp_path / "a", pictures, MOVING, noisy=noisy), require_poses=False)
    frames = list(prefetch(RecordingStream(recording)))
    assert all((frame.image is None) == ("repeats the picture of" in frame.problem) for frame in frames)
    return [frame.image is not None for frame in frames]


def test_a_stream_whose_picture_repeats_after_a_motion_has_gaps(tmp_path):
    stale = {*range(12, 20), *range(42, 46)}  # the first repeat may be one of a slower camera
    assert answered(HELD, tmp_path) == [i not in stale for i in range(N)]


@pytest.mark.parametrize("pictures", [RESTING, MOVING // 2 * 2, np.maximum(MOVING, 30)])
def test_a_stream_that_rests_or_repeats_once_has_no_gap(tmp_path, pictures):
    assert all(answered(pictures, tmp_path))


def test_a_rendered_camera_that_stops_smoothly_has_no_gap():
    watch, still = RepeatWatch(), np.asarray(picture(5))
    slow = still.copy()
    slow[::9, ::9] ^= 1  # hardly any pixel changes before it stops
    images = [np.asarray(picture(at)) for at in range(5)] + [slow] + 20 * [still]
    assert [watch.check(image, i / RATE_HZ, f"{i}") for i, image in enumerate(images)] == [""] * len(images)


def test_a_new_recording_begins_anew(tmp_path):
    recording = read_recording(write(tmp_path / "a", HELD, MOVING), require_poses=False)
    assert isinstance(recording.camera, PinholeCamera)
    parts = replace(recording, recording=np.arange(N))
    assert isinstance(parts, Recording)
    assert all(frame.image is not None for frame in prefetch(RecordingStream(parts)))
