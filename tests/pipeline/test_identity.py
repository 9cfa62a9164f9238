"""Known data is known by pixels, poses and camera, frame by frame."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from conformodal.cli.answering import Part, part_frames
from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.io import PixelNoise, Recording, read_recording
from conformodal.pipeline.errors import OdometryError
from conformodal.pipeline.identity import data_digest, identify
from conformodal.pipeline.selection import calibrate_selection
from conformodal.pipeline.store import load_model, save_model
from tests.helpers import fly

CAMERA = PinholeCamera(10.0, 10.0, 4.0, 3.0, 8, 6)


@pytest.fixture(scope="module")
def model(small_world):
    return load_model(small_world.model)


@pytest.fixture
def copy(small_corridor, tmp_path):
    """The small world's files, to be changed."""
    return shutil.copytree(small_corridor, tmp_path / "copy")


def frames(folder, pictures, poses=True):
    """Frames with these seeds of their pixels, and poses that differ."""
    folder.mkdir(parents=True, exist_ok=True)
    paths, n = [], len(pictures)
    for i, seed in enumerate(pictures):
        paths.append(folder / f"{i}.png")
        Image.fromarray(np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)).save(paths[-1])
    times = np.arange(float(n))
    quats = Rotation.from_euler("y", 10.0 * np.arange(n)[:, None], degrees=True).as_quat(scalar_first=True)
    truth = Trajectory(times, np.column_stack((times, times, times)), quats) if poses else None
    return Recording("made up", tuple(paths), times, np.zeros(n, dtype=np.int64), CAMERA, truth)


def chosen(sequence, order):
    """Its frames in another order, with their poses, at new times."""
    order = np.asarray(order)
    times = np.arange(float(len(order)))
    truth = sequence.truth and replace(sequence.truth[order], timestamps_s=times)
    paths = tuple(sequence.image_paths[i] for i in order)
    return replace(sequence, image_paths=paths, timestamps_s=times, recording=sequence.recording[order], truth=truth)


def turned(sequence, quats):
    return replace(sequence, truth=replace(sequence.truth, orientations_quat_wxyz=quats))


def test_frames_are_found_in_any_order_under_any_name_and_in_any_lossless_file(tmp_path):
    own = frames(tmp_path / "a", range(6))
    known = identify(own)
    other = chosen(own, [4, 2, 0, 5])
    paths = []
    for i, path in enumerate(other.image_paths):
        paths.append(tmp_path / f"new{i}.bmp")
        Image.open(path).save(paths[-1])
    found = known.find(identify(replace(other, image_paths=tuple(paths)), known))
    assert found.at.tolist() == [2, -1, 1, -1, 0, 3]
    assert (found.moved == -1).all()
    noisy = identify(replace(own, noise=PixelNoise(0.1)))
    np.testing.assert_array_equal(noisy.pixels, known.pixels)


def test_other_pixels_under_the_same_names_are_not_known(tmp_path):
    known = identify(frames(tmp_path, range(4)))
    here = identify(frames(tmp_path, [0, 11, 12, 3]), known)  # the same files, written over
    assert known.known(here).tolist() == [True, False, False, True]
    assert known.find(here).at.tolist() == [0, -1, -1, 3]


def test_one_pixel_or_the_shape_makes_another_image(tmp_path):
    own = frames(tmp_path, [1])
    known, path = identify(own), own.image_paths[0]
    pixels = np.array(Image.open(path))
    one = pixels.copy()
    one[2, 3, 0] ^= 1
    for other in (one, pixels.reshape(8, 6, 3)):
        Image.fromarray(other).save(path)
        assert not known.known(identify(own, known)).any()


def test_images_that_cannot_be_read_match_nothing(tmp_path):
    own = frames(tmp_path, range(3))
    own.image_paths[0].write_bytes(b"no image")
    own.image_paths[1].unlink()
    known = identify(own)
    assert known.known(known).tolist() == [False, False, True]
    assert known.find(known).at.tolist() == [-1, -1, 2]


def test_poses_are_the_same_but_for_rounding_and_sign(tmp_path):
    own = frames(tmp_path, range(4))
    known, truth = identify(own), own.truth
    near = Trajectory(truth.timestamps_s, truth.positions_xyz + 1e-7, -truth.orientations_quat_wxyz)
    assert known.find(identify(replace(own, truth=near), known)).at.tolist() == [0, 1, 2, 3]
    assert known.find(identify(replace(own, truth=None), known)).at.tolist() == [0, 1, 2, 3]  # none to compare
    moved = replace(truth, positions_xyz=truth.positions_xyz + np.array([[0, 0, 0], [0, 2e-5, 0]] * 2))
    found = known.find(identify(replace(own, truth=moved), known))
    assert found.at.tolist() == [0, -1, 2, -1]
    assert found.moved.tolist() == [-1, 1, -1, 3]


def test_frames_that_look_the_same_are_told_apart_by_their_poses(tmp_path):
    own = frames(tmp_path, [7, 7, 8, 7])
    known = identify(own)
    assert known.find(identify(chosen(own, [3, 2, 0]), known)).at.tolist() == [2, -1, 1, 0]
    still = turned(chosen(own, [0, 0, 2, 0]), own.truth.orientations_quat_wxyz[[0, 0, 2, 0]])
    twice = identify(still).find(identify(chosen(still, [0, 1, 2, 3, 0])))
    assert twice.at.tolist() == [0, 1, 2, 3]  # the fifth is one too many
    assert (twice.moved == -1).all()


@pytest.mark.parametrize("colour", [(0, 0, 0), (10, 200, 30)])
def test_images_of_one_colour_make_no_recording_known(tmp_path, colour):
    """As those before a camera starts: two recordings have them."""
    one, other = frames(tmp_path / "a", [1, 2, 3]), frames(tmp_path / "b", [4, 5, 3])
    image = Image.new("RGB", (8, 6), colour)
    for last, is_known in ((colour, False), ((*colour[:2], colour[2] + 1), True)):
        image.putpixel((7, 5), last)
        for sequence, k in ((one, 0), (other, 1)):
            image.save(sequence.image_paths[k])
        known = identify(one)
        assert known.known(identify(other)).tolist() == [False, is_known, True]
        assert known.find(identify(one)).at.tolist() == [0, 1, 2]  # one's own, also by its pose


def test_the_digest_of_a_data_set_knows_what_results_rest_on(tmp_path):
    own = frames(tmp_path / "a", range(4))
    assert data_digest(own) == data_digest(frames(tmp_path / "b", range(4)))
    others = (
        frames(tmp_path / "c", [0, 1, 2, 9]),
        turned(own, own.truth.orientations_quat_wxyz[::-1]),
        chosen(own, [0, 1, 2]),
        replace(own, camera=replace(CAMERA, fx=11.0)),
        replace(own, timestamps_s=own.timestamps_s + 1),
        replace(own, truth=None),
    )
    assert len({data_digest(sequence) for sequence in (own, *others)}) == 7


def test_a_saved_model_knows_its_frames(model, sequence, tmp_path):
    save_model(model, tmp_path)
    back = load_model(tmp_path).known_frames
    fresh = identify(sequence)
    assert len(back) == len(sequence)
    for name in ("files", "pixels", "poses"):
        np.testing.assert_array_equal(getattr(back, name), getattr(model.known_frames, name))
        np.testing.assert_array_equal(getattr(back, name), getattr(fresh, name))


def test_files_that_have_not_changed_are_not_decoded(model, sequence, monkeypatch):
    monkeypatch.setattr("conformodal.pipeline.identity._DECODED", {})
    monkeypatch.setattr("conformodal.pipeline.identity.read_image", lambda path: pytest.fail(f"{path} was decoded"))
    assert model.known_frames.known(identify(sequence, model.known_frames)).all()


def test_a_part_is_found_whatever_the_frames_are_called(model, copy):
    """Renamed to other numbers, in another order, at another rate."""
    n = len(model.known_frames)
    for path in sorted((copy / "seq-01").glob("frame-*")):
        number = int(path.name[6:12])
        path.rename(path.with_name(f"frame-{2000 - number:06d}{path.name[12:]}"))
    (copy / "frame-rate.txt").write_text("7\n")
    here = read_recording(copy)
    assert part_frames(model, here, Part.ALL) is None
    for part in (Part.TEST, Part.CALIBRATION, Part.TRAIN):
        assert part_frames(model, here, part).tolist() == (n - 1 - model.split.part(str(part)))[::-1].tolist()


def test_other_images_under_the_same_names_have_no_part(model, copy):
    for path in (copy / "seq-01").glob("*.png"):
        with Image.open(path) as image:
            Image.fromarray(255 - np.asarray(image.convert("RGB"))).save(path)
    n = len(model.split.test)
    with pytest.raises(OdometryError, match=rf"copy: .*none of the {n} frames of the test part"):
        part_frames(model, read_recording(copy), Part.TEST)


def test_a_part_with_other_poses_is_refused(model, sequence):
    test = model.split.test
    true = Rotation.from_quat(sequence.truth.orientations_quat_wxyz, scalar_first=True)
    quarter = Rotation.from_euler("z", 90, degrees=True) * true
    here = turned(sequence, quarter.as_quat(scalar_first=True))
    with pytest.raises(OdometryError, match=rf"frame-{test[0]:06d}\.color\.png: .*another pose, as {len(test)} of"):
        part_frames(model, here, Part.TEST)
    backwards = sequence.truth[::-1]
    mixed = replace(sequence, truth=replace(backwards, timestamps_s=sequence.timestamps_s))
    with pytest.raises(OdometryError, match="another pose"):
        part_frames(model, mixed, Part.TEST)
    one = sequence.truth.positions_xyz.copy()
    one[test[4], 1] += 0.01
    moved = replace(sequence, truth=replace(sequence.truth, positions_xyz=one))
    with pytest.raises(OdometryError, match=rf"frame-{test[4]:06d}.*another pose, as 1 of {len(test)}"):
        part_frames(model, moved, Part.TEST)
    assert len(part_frames(model, moved, Part.TRAIN)) == len(model.split.train)


def test_a_part_with_another_camera_is_refused(model, sequence):
    camera = replace(sequence.camera, fx=sequence.camera.fx + 0.01)
    with pytest.raises(OdometryError, match=rf"frame-{model.split.test[0]:06d}.*another camera: .*trained with.*has"):
        part_frames(model, replace(sequence, camera=camera), Part.TEST)
    same = replace(sequence, camera=replace(sequence.camera, distortion=(0.0,) * 4))
    assert len(part_frames(model, same, Part.TEST)) == len(model.split.test)


def test_calibrate_refuses_data_of_which_it_knows_a_frame(model, copy, tmp_path):
    last = sorted((copy / "seq-01").glob("*.png"))[-1]
    for path in (last, last.with_name(last.name.replace("color.png", "pose.txt"))):
        path.unlink()
    less = read_recording(copy)
    with pytest.raises(OdometryError, match=rf"frame-000000.*{len(less)} of {len(less)} frames; calibrate on other"):
        calibrate_selection(model, less)
    flight = fly(tmp_path / "flight", 50, slice(4), 9)
    new = read_recording(flight)
    assert not model.known_frames.known(identify(new)).any()
    shutil.copy(less.image_paths[int(model.split.train[5])], flight / "frame-000002.color.png")
    with pytest.raises(OdometryError, match=r"frame-000002.*1 of 4 frames"):
        calibrate_selection(model, read_recording(flight))
