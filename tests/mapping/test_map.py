"""Rendered clips become recordings that are right, in metres if anything tells them; wrong ones are refused."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from conformodal.core.extras import MissingPackageError
from conformodal.geometry.metrics import umeyama
from conformodal.io import DatasetError, read_recording
from conformodal.io.streams.frames import SourceError
from conformodal.mapping import KnownLength, MapError, Placement, build_map, settings
from conformodal.mapping.clips import open_sources, write_clips
from conformodal.mapping.matching import match_keyframes
from conformodal.mapping.world import Up
from tests.helpers import contents

from .conftest import CAMERA, N_FRAMES, SETTINGS, render, sweep

pytest.importorskip("pycolmap")


def errors(recording, truth):
    """Distances of positions from the true ones, after a similarity; and its scale, to metres."""
    R, t, scale = umeyama(recording.truth.positions_xyz, truth.positions_xyz, with_scale=True)
    return np.linalg.norm(scale * recording.truth.positions_xyz @ R.T + t - truth.positions_xyz, axis=1), scale


@pytest.fixture(scope="module")
def mapped(clip, tmp_path_factory):
    """The map of a clip in metres, by the distance between two of its cameras."""
    out, truth = tmp_path_factory.mktemp("maps") / "recording", sweep(4.0)
    ends = np.linalg.norm(truth.positions_xyz[-2] - truth.positions_xyz[1])
    stages = []
    made = build_map(
        [clip],
        out,
        placement=Placement(KnownLength("001.png", f"{N_FRAMES - 2:03d}", float(ends))),
        settings=SETTINGS,
        report=lambda stage, done, total: stages.append((stage, done, total)),
    )
    return out, made, stages


def test_a_clip_becomes_a_recording_in_metres_that_is_upright(mapped):
    out, made, _ = mapped
    recording, truth = read_recording(out), sweep(4.0)
    assert made.written
    assert not made.reasons
    assert (len(recording), recording.unit, made.world.unit) == (N_FRAMES, "m", "m")
    off, scale = errors(recording, truth)
    assert np.median(off) < 0.01
    assert off.max() < 0.05
    assert scale == pytest.approx(1, abs=0.02)  # a length between two cameras has the error of both
    assert recording.camera.fx == pytest.approx(CAMERA.fx, rel=0.03)
    # the cameras are held level, within the little that they pitch
    R = umeyama(recording.truth.positions_xyz, truth.positions_xyz, with_scale=True).R
    assert R[2, 2] > np.cos(np.radians(6))
    np.testing.assert_allclose(recording.timestamps_s, np.arange(N_FRAMES) / 30)  # folders of images have no times


def test_keyframes_are_mapped_and_all_frames_registered(mapped):
    _, made, stages = mapped
    quality = made.quality
    assert 5 < quality.n_keyframes < N_FRAMES
    assert (quality.n_mapped, quality.n_registered, quality.n_pieces) == (quality.n_keyframes, N_FRAMES, 1)
    assert quality.agreeing > 0.9
    assert quality.n_loops > 0
    assert quality.views_per_point > 3
    assert {stage for stage, *_ in stages} == {"frames", "features", "matching", "mapping", "between"}
    assert all(done <= total for _, done, total in stages)
    assert made.seconds > 0
    assert made.peak_bytes > 1e7


def test_the_record_says_what_the_map_is(mapped):
    out, made, _ = mapped
    record = json.loads((out / "map.json").read_text())
    assert record == json.loads(json.dumps(made.record()))
    assert record["trusted"]
    assert record["unit"] == "m"
    assert (out / "frames.csv").read_text().splitlines()[1] == '1-room/000000.png,"000.png",0.000000000'


@pytest.mark.slow
def test_positions_give_scale_axes_and_residuals(clip, tmp_path):
    truth, out = sweep(4.0), tmp_path / "recording"
    known = [0, 6, 12, 18, 23]
    positions = truth.positions_xyz.copy()
    positions[6, 2] += 0.3  # a mistake in the list, which the residuals show
    lines = [f"{k:03d}.png {' '.join(map(str, positions[k]))}" for k in known]
    (tmp_path / "positions.txt").write_text("image x y z\n" + "\n".join(lines) + "\n")
    placement = Placement(positions_file=tmp_path / "positions.txt")
    made = build_map([clip], out, placement=placement, settings=SETTINGS)
    recording = read_recording(out)
    assert recording.unit == "m"
    off = np.linalg.norm(recording.truth.positions_xyz - truth.positions_xyz, axis=1)
    assert np.median(off) < 0.2
    assert made.world.residuals_m.argmax() == 1


@pytest.mark.slow
def test_a_known_camera_is_kept(clip, tmp_path):
    (tmp_path / "camera-intrinsics.txt").write_text("260 0 159.5\n0 260 119.5\n0 0 1\n")
    build_map([clip], tmp_path / "out", camera_file=tmp_path, settings=SETTINGS)
    recording = read_recording(tmp_path / "out")
    assert recording.camera == CAMERA
    off, _ = errors(recording, sweep(4.0))
    assert np.median(off) < 0.01
    assert recording.unit == "units"


@pytest.mark.slow
def test_two_videos_of_one_room_share_a_world(clip, tmp_path):
    back = render(tmp_path / "back", sweep(4.0)[::-1])
    build_map([clip, back], tmp_path / "out", settings=SETTINGS)
    recording, truth = read_recording(tmp_path / "out"), sweep(4.0).positions_xyz
    assert recording.recording.tolist() == [0] * N_FRAMES + [1] * N_FRAMES
    assert np.diff(recording.timestamps_s).max() == pytest.approx(10)
    both = np.concatenate((truth, truth[::-1]))
    R, t, scale = umeyama(recording.truth.positions_xyz, both, with_scale=True)
    off = np.linalg.norm(scale * recording.truth.positions_xyz @ R.T + t - both, axis=1)
    assert np.median(off) < 0.01


@pytest.mark.slow
def test_unconnected_video_is_named_and_nothing_written(clip, elsewhere, tmp_path):
    out = tmp_path / "out"
    made = build_map([clip, elsewhere], out, settings=SETTINGS)
    assert not made.written
    named = re.fullmatch(
        r"(.*) does not connect to the others; record it again from a view of the.*", str(made.reasons[0])
    )
    assert named[1] in (str(clip), str(elsewhere))  # the larger piece is the map
    assert list(tmp_path.iterdir()) == []
    trusted = build_map([clip, elsewhere], out, settings=replace(SETTINGS, trust_map=True))
    assert trusted.written
    assert len(read_recording(out)) == N_FRAMES
    assert not json.loads((out / "map.json").read_text())["trusted"]


# ---- what no map can be made of


def test_a_camera_that_only_turns_is_refused(turning, tmp_path):
    with pytest.raises(MapError, match=r"turning: no parallax: .* within 0\.\d px, expected 3; move the camera side"):
        build_map([turning], tmp_path / "out", settings=SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_a_camera_that_stands_still_is_refused(tmp_path):
    still = render(tmp_path / "still", sweep(4.0)[np.zeros(5, dtype=np.int64)])
    with pytest.raises(MapError, match=r"still: 5 frames with 1 different view, expected 3 or more views; move the"):
        build_map([still], tmp_path / "out", settings=SETTINGS)
    assert not (tmp_path / "out").exists()


def test_sources_without_frames_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    for name, why in (("empty", "holds no image"), ("missing.mp4", "no such file or folder")):
        with pytest.raises(DatasetError, match=f"{name}: {why}"):
            build_map([tmp_path / name], tmp_path / "out")
    (tmp_path / "text.mp4").write_text("not a video")
    with pytest.raises(SourceError, match="cannot be opened as a video"):
        build_map([tmp_path / "text.mp4"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_output_that_is_not_empty_stays_as_it_is(clip, tmp_path):
    (tmp_path / "mine").write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(DatasetError, match="is not empty"):
        build_map([clip], tmp_path)
    assert contents(tmp_path) == before


def test_duplicate_video_and_second_camera_are_refused(clip, tmp_path):
    with pytest.raises(MapError, match="is given twice"):
        build_map([clip, clip.parent / "." / clip.name], tmp_path / "out")
    (tmp_path / "camera-intrinsics.txt").write_text("260 0 159.5\n0 260 119.5\n0 0 1\n")
    calibrated = render(tmp_path / "calibrated", sweep(4.0)[:3])
    (calibrated / "camera-intrinsics.txt").write_text("260 0 159.5\n0 260 119.5\n0 0 1\n")
    with pytest.raises(MapError, match="calibrated: has a camera, fx = 260, and --camera gives one"):
        build_map([calibrated], tmp_path / "out", camera_file=tmp_path)


def frames_of(folder, work, camera_file=None):
    """Clips of a folder of images, in a new folder."""
    return write_clips(open_sources([folder], camera_file), work, SETTINGS)


def test_images_are_copied_by_their_format_not_suffix(tmp_path):
    folder = render(tmp_path / "room", sweep(4.0)[:3])
    with Image.open(folder / "001.png") as image:
        image.save(folder / "001.png", format="WEBP")
    (clip,) = frames_of(folder, tmp_path / "work")
    assert [Path(image).suffix for image in clip.images] == [".png", ".jpg", ".png"]
    with Image.open(tmp_path / "work" / clip.images[1]) as image:
        assert image.format == "JPEG"


def test_an_image_that_pycolmap_cannot_read_is_named(tmp_path):
    clips = frames_of(render(tmp_path / "room", sweep(4.0)), tmp_path / "work")
    (tmp_path / "work" / clips[0].keyframe_images[1]).write_bytes(b"not an image")
    named = clips[0].source_names[clips[0].keyframes[1]]
    with pytest.raises(MapError, match=rf"room: {named}: pycolmap cannot read the image"):
        match_keyframes(clips, tmp_path / "work", tmp_path / "matches.db", SETTINGS)


@pytest.mark.parametrize("given", [True, False])
def test_doubts_about_a_camera_are_noted(tmp_path, given):
    folder = render(tmp_path / "room", sweep(4.0)[:3])
    file = (tmp_path if given else folder) / "camera-intrinsics.txt"
    file.write_text("260 0 80\n0 260 60\n0 0 1\n")
    (clip,) = frames_of(folder, tmp_path / "work", file if given else None)
    (note,) = clip.notes
    assert (note.what, "principal point" in note.where) == ("camera is unlikely", True)


def test_a_camera_that_only_the_layout_tells_is_fitted(tmp_path):
    images = render(tmp_path / "seq-01", sweep(4.0)[:3])
    for k in range(3):
        path = images / f"frame-{k:06d}.color.png"
        with Image.open(images / f"{k:03d}.png") as image:
            image.resize((640, 480)).save(path)
        (images / f"{k:03d}.png").unlink()
        np.savetxt(images / f"frame-{k:06d}.pose.txt", np.eye(4))
    (clip,) = frames_of(tmp_path, tmp_path / "work")
    assert (clip.camera, clip.notes) == (None, ())
    (tmp_path / "camera.txt").write_text("520 0 319.5\n0 520 239.5\n0 0 1\n")
    (clip,) = frames_of(tmp_path, tmp_path / "again", tmp_path / "camera.txt")
    assert clip.camera.fx == 520


@pytest.mark.parametrize(
    ("length", "why"),
    [
        (("000.png", "000.png", 1.0), "needs two images, got 000.png twice"),
        (("000.png", "001.png", 0.0), "must be a positive number of metres, got 0"),
        (("000.png", "001.png", np.nan), "must be a positive number of metres, got nan"),
    ],
)
def test_a_length_that_cannot_be_is_refused_before_the_work(tmp_path, length, why):
    with pytest.raises(MapError, match=why):
        build_map([tmp_path / "missing"], tmp_path / "out", placement=Placement(KnownLength(*length)))


@pytest.mark.parametrize(
    ("names", "why"),
    [
        (("000.png", "99.png"), "no frame is called 99.png, expected a name such as 000.png"),
        (("000.png", "000"), "000 and 000.png are one image"),
    ],
)
def test_names_that_are_wrong_are_refused_before_the_long_work(clip, tmp_path, names, why):
    stages = set()
    placement = Placement(KnownLength(*names, 1.0))
    with pytest.raises(MapError, match=f"--known-length: {why}"):
        build_map([clip], tmp_path / "out", placement=placement, report=lambda stage, *_: stages.add(stage))
    assert stages == {"frames"}
    (tmp_path / "positions.txt").write_text("000.png 0 0 0\n001.png 1 0 0\nthird.png 0 1 0\n")
    with pytest.raises(MapError, match=r"positions\.txt: no frame is called third\.png"):
        build_map([clip], tmp_path / "out", placement=Placement(positions_file=tmp_path / "positions.txt"))
    assert [path.name for path in tmp_path.iterdir()] == ["positions.txt"]


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (["a 0 0 0", "b 1 0 0"], "holds 2 positions, expected three or more"),
        (["a 0 0 0", "b 1 0 0", "c 2 0 0.001"], "its positions lie on a line or in one place"),
        (["a 0 0 0", "a 1 0 0", "c 2 2 0"], "gives a twice"),
        (["a 0 0 0", "b 1 x 0", "c 2 2 0"], r"line 2: expected 'image x y z' in metres, got 'b 1 x 0'"),
    ],
)
def test_degenerate_positions_are_refused_before_the_work(tmp_path, lines, why):
    (tmp_path / "positions.txt").write_text("\n".join(lines))
    placement = Placement(positions_file=tmp_path / "positions.txt")
    with pytest.raises((MapError, DatasetError), match=f"positions.txt.*{why}"):
        build_map([tmp_path / "missing"], tmp_path / "out", placement=placement)


def test_without_pycolmap_the_pip_line_is_said(clip, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(
        MissingPackageError, match=r"mapping a video needs pycolmap, .*: pip install 'conformodal\[colmap\]'"
    ):
        build_map([clip], tmp_path / "out")


def test_a_pycolmap_without_a_global_mapper_is_too_old(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(settings, "NEEDED", ("a_function_of_later",))
    with pytest.raises(MissingPackageError, match="needs pycolmap 4 or newer"):
        build_map([clip], tmp_path / "out")


@pytest.mark.slow
def test_a_video_held_sideways_is_mapped_as_it_is_shown(clip, tmp_path):
    path = tmp_path / "phone.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (CAMERA.height, CAMERA.width))
    for image in sorted(clip.iterdir()):
        writer.write(cv2.rotate(cv2.imread(str(image)), cv2.ROTATE_90_CLOCKWISE))
    writer.release()
    build_map([path], tmp_path / "out", placement=Placement(up=Up.RIGHT), settings=SETTINGS)
    recording, truth = read_recording(tmp_path / "out", require_poses=False), sweep(4.0)
    assert (recording.camera.width, recording.camera.height) == (CAMERA.height, CAMERA.width)
    assert len(recording.poses) >= 0.9 * N_FRAMES
    np.testing.assert_allclose(recording.timestamps_s, truth.timestamps_s, atol=1e-3)
    R = umeyama(recording.poses.positions_xyz, truth.positions_xyz[recording.posed], with_scale=True).R
    assert R[2, 2] > np.cos(np.radians(6))  # z is up


@pytest.mark.slow
def test_map_of_a_real_desk_matches_motion_capture(real_data, tmp_path):
    desk = real_data("tum", "fr1_desk")
    recording = read_recording(desk)
    images = tmp_path / "images"
    images.mkdir()
    for time_s, path in zip(recording.timestamps_s[100:150], recording.image_paths[100:150], strict=True):
        (images / f"{time_s:.6f}.jpg").symlink_to(path)  # neither the camera nor poses are told
    made = build_map([images], tmp_path / "out")
    assert not made.reasons
    assert made.quality.registered >= 0.95
    mapped = read_recording(tmp_path / "out", require_poses=False).poses
    truth = recording.truth.positions_xyz[np.searchsorted(recording.timestamps_s, mapped.timestamps_s - 1e-4)]
    R, t, scale = umeyama(mapped.positions_xyz, truth, with_scale=True)
    assert np.median(np.linalg.norm(scale * mapped.positions_xyz @ R.T + t - truth, axis=1)) < 0.02
