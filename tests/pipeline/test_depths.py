import shutil
from dataclasses import replace

import numpy as np
import pytest

from conformodal.geometry import PoseError, matrix_from_quat_wxyz
from conformodal.io import ImageError, read_recording
from conformodal.pipeline.depths import measure_depths
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.store import load_model, save_model
from conformodal.tracking.motions import measure_motions


class Watched:
    """A sequence that notes which images were looked at."""

    def __init__(self, sequence):
        self.sequence, self.asked = sequence, []

    def __getattr__(self, name):
        return getattr(self.sequence, name)

    def image(self, i):
        self.asked.append(i)
        return self.sequence.image(i)


def test_depths_of_redkitchen_are_those_of_a_kitchen(redkitchen):
    sequence = Watched(read_recording(redkitchen))
    frames = np.sort(np.random.default_rng(0).choice(1000, 640, replace=False))
    depth, spread = measure_depths(sequence, frames)
    assert set(sequence.asked) <= set(frames.tolist())  # test frames are not looked at
    assert len(sequence.asked) <= 120
    assert 1.4 < depth < 2.6
    assert 0.1 <= spread < 0.6


def test_few_frames_say_nothing(redkitchen):
    sequence = read_recording(redkitchen)
    for frames in (np.arange(4), np.array([5]), np.array([], dtype=np.int64), np.arange(0, 1000, 200)):
        assert np.isnan(measure_depths(sequence, frames)).all()


def test_bad_sequences_are_told(redkitchen, tmp_path):
    for path in sorted(redkitchen.glob("frame-00000*")):
        shutil.copy(path, tmp_path)
    sequence = read_recording(tmp_path)
    with pytest.raises(PoseError):
        measure_depths(replace(sequence, poses=None), np.arange(10))
    sequence.image_paths[3].write_bytes(b"no image")
    with pytest.raises(ImageError, match="frame-000003"):
        measure_depths(sequence, np.arange(10))


def test_a_model_that_knows_no_depths_is_saved_and_answers(small_world, tmp_path):
    model = load_model(small_world.model)
    assert np.isfinite(model.prior.depth_m)
    model.prior = replace(model.prior, depth_m=np.nan, depth_spread=np.nan)
    save_model(model, tmp_path / "model")
    back = load_model(tmp_path / "model")
    assert np.isnan([back.prior.depth_m, back.prior.depth_spread]).all()
    sequence = read_recording(small_world.folder)
    run = VisualOdometry(back).process(sequence, np.arange(12))
    assert run.observations(np.arange(12)).submaps
    assert np.isfinite(run.trajectory.positions_xyz).all()


def test_submaps_stay_within_a_recording_and_name_its_frames(small_world, two_recordings):
    both = two_recordings
    n = len(both) // 2
    frames = np.arange(n - 20, n + 20)
    found = measure_motions(both, frames)
    assert found.submaps
    for submap in found.submaps:
        assert set(submap.frames.tolist()) <= set(frames.tolist())
        assert len(set(both.recording[submap.frames].tolist())) == 1
    run = VisualOdometry.load(small_world.model).process(both, frames)
    assert (np.diff(run.recording) >= 0).all()
    first, second = (run.observations(rows).submaps for rows in (np.arange(20), np.arange(20, 40)))
    assert len(first) + len(second) == len(found.submaps)
    assert all(s.frames[-1] < 20 for s in (*first, *second))
    # the submaps' paths are those of the truth, but for their lengths
    truth = both.require_truth()
    misses = []
    for submap in found.submaps:
        places = truth.positions_xyz[submap.frames] - truth.positions_xyz[submap.frames[0]]
        path = submap.positions @ matrix_from_quat_wxyz(truth.orientations_quat_wxyz[submap.frames[:1]])[0].T
        length = (path * places).sum() / (path**2).sum()
        misses.append(np.sqrt(((length * path - places) ** 2).mean()) / (abs(length) * submap.sigma))
    assert np.median(misses) < 1
