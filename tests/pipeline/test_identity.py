"""Known data is recognised by files, poses and camera, frame by frame."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from conformodal.cli.answering import Part, part_frames
from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.io import Recording, read_recording
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.identity import identify, same_poses
from conformodal.pipeline.store import load_model, save_model

CAMERA = PinholeCamera(10.0, 10.0, 4.0, 3.0, 8, 6)


@pytest.fixture(scope="module")
def model(small_world):
    return load_model(small_world.model)


@pytest.fixture
def copy(small_corridor, tmp_path):
    """The small world's files, to be changed."""
    return shutil.copytree(small_corridor, tmp_path / "copy")


def frames(folder, pictures):
    """Frames with these seeds of their pixels, and poses that differ."""
    folder.mkdir(parents=True, exist_ok=True)
    paths, n = [], len(pictures)
    for i, seed in enumerate(pictures):
        paths.append(folder / f"{i}.png")
        Image.fromarray(np.random.default_rng(seed).integers(0, 256, (6, 8, 3), np.uint8)).save(paths[-1])
    times = np.arange(float(n))
    quats = Rotation.from_euler("y", 10.0 * np.arange(n)[:, None], degrees=True).as_quat(scalar_first=True)
    truth = Trajectory(times, np.column_stack((times, times, times)), quats)
    return Recording("made up", tuple(paths), times, np.zeros(n, dtype=np.int64), CAMERA, truth)


def test_frames_are_found_in_any_order_under_any_name(tmp_path):
    recording = frames(tmp_path / "a", [0, 7, 2, 7])
    known, here = identify(recording), identify(frames(tmp_path / "b", [7, 2, 11, 7, 7]))
    assert known.find(here).tolist() == [-1, 0, 1, 3]  # copies in order
    assert known.known(here).tolist() == [True, True, False, True, True]
    recording.image_paths[1].unlink()  # a file that cannot be read matches nothing
    known = identify(recording)
    assert known.known(known).tolist() == [True, False, True, True]
    assert known.find(known).tolist() == [0, -1, 2, 3]


def test_poses_are_the_same_but_for_rounding_and_sign(tmp_path):
    poses = identify(frames(tmp_path, range(4))).poses
    assert same_poses(poses, poses * [1, 1, 1, -1, -1, -1, -1] + 1e-8).all()
    assert same_poses(poses, np.full((4, 7), np.nan)).all()  # none to compare
    moved = poses + np.eye(7)[1] * [[0], [2e-5], [0], [2e-5]]
    assert same_poses(poses, moved).tolist() == [True, False, True, False]


def test_a_part_is_found_whatever_the_frames_are_called(model, sequence, copy, tmp_path):
    """Renamed to other numbers, in another order, at another rate; and by a model that was saved."""
    save_model(model, tmp_path / "model")
    n = len(model.known_frames)
    for path in sorted((copy / "seq-01").glob("frame-*")):
        number = int(path.name[6:12])
        path.rename(path.with_name(f"frame-{2000 - number:06d}{path.name[12:]}"))
    (copy / "frame-rate.txt").write_text("7\n")
    back, here = load_model(tmp_path / "model"), read_recording(copy)
    assert part_frames(back, here, Part.ALL) is None
    assert part_frames(back, here, Part.TEST).tolist() == (n - 1 - model.split.test)[::-1].tolist()


def test_data_that_is_not_the_models_has_no_part(model, sequence, tmp_path):
    test = model.split.test
    name = rf"frame-{test[0]:06d}\.color\.png"
    with pytest.raises(OdometryError, match=f"none of the {len(test)} frames of the test part"):
        part_frames(model, frames(tmp_path, range(4)), Part.TEST)
    one = sequence.truth.positions_xyz.copy()
    one[test[0], 1] += 0.01
    moved = replace(sequence, poses=replace(sequence.truth, positions_xyz=one))
    with pytest.raises(OdometryError, match=rf"{name}: .*another pose, as 1 of {len(test)} frames"):
        part_frames(model, moved, Part.TEST)
    camera = replace(sequence.camera, fx=sequence.camera.fx + 0.01)
    with pytest.raises(OdometryError, match=rf"{name}: .*another camera"):
        part_frames(model, replace(sequence, camera=camera), Part.TEST)
    same = replace(sequence, camera=replace(sequence.camera, distortion=(0.0,) * 4))
    assert len(part_frames(model, same, Part.TEST)) == len(test)
