"""What is written in a layout and read back is what it was: poses, times, camera, order, and who has no pose."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.io import Recording, read_recording
from conformodal.io.convert import convert_stream
from conformodal.io.streams.frames import RecordingStream

SIZE = (64, 48)
LENSES = [(), (-0.1, 0.02, 0.001, 0.002), (-0.1, 0.02, 0.001, 0.002, 0.003)]
pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")


@st.composite
def sources(draw):
    """A data set without its images: times with gaps, any poses, some of them unknown, any camera."""
    n, rng = draw(st.integers(2, 5)), np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rate, start = draw(st.sampled_from([7.5, 10.0, 24.0, 30.0])), draw(st.sampled_from([0.0, 5.25, 1305031102.175304]))
    steps = rng.integers(1, 4, n - 1)
    steps[0] = 1  # the usual step occurs
    times = start + np.concatenate(([0], np.cumsum(steps))) / rate
    poses = Trajectory(times, 10 ** rng.uniform(-3, 3) * rng.normal(size=(n, 3)), rng.normal(size=(n, 4)))
    f, c = rng.uniform(30, 200), rng.uniform(0.4, 0.6, 2) * SIZE
    camera = PinholeCamera(f, f * rng.uniform(0.9, 1.1), *c.tolist(), *SIZE, LENSES[draw(st.integers(0, 2))])
    posed = rng.random(n) < draw(st.sampled_from([0.5, 1.0]))
    posed[0] = True
    return poses, camera, posed


def check_round_trip(source):
    poses, camera, posed = source
    truth = poses[np.flatnonzero(posed)]
    with tempfile.TemporaryDirectory() as scratch:
        paths = [Path(scratch) / f"{'zyxwv'[i]}.{('png', 'jpg')[i % 2]}" for i in range(len(poses))]  # in no order
        for i, path in enumerate(paths):
            Image.new("RGB", SIZE, (5 * i, 0, 0)).save(path)
        before = Recording("a", tuple(paths), poses.timestamps_s, np.zeros(len(poses), int), camera)
        done = convert_stream(Path(scratch) / "b", RecordingStream(before), camera, truth, max_gap_s=0)
        after = read_recording(Path(scratch) / "b", require_poses=False)
        assert (done.n_frames, done.n_posed) == (len(posed), posed.sum())
        reds = [after.image(i)[0, 0, 0] for i in range(len(after))]
        np.testing.assert_allclose(reds, 5 * np.arange(len(posed)), atol=2)  # JPEG
    np.testing.assert_allclose(after.timestamps_s, before.timestamps_s, atol=1e-6, rtol=0)
    np.testing.assert_array_equal(np.isin(after.timestamps_s, after.poses.timestamps_s), posed)
    scale = np.abs(truth.positions_xyz).max()
    np.testing.assert_allclose(after.poses.positions_xyz, truth.positions_xyz, atol=1e-12 * scale, rtol=0)
    np.testing.assert_allclose(after.poses.poses_se3[:, :3, :3], truth.poses_se3[:, :3, :3], atol=1e-12)
    assert after.camera == camera


few = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@given(source=sources())
@few
def test_what_is_written_is_read_back(source):
    check_round_trip(source)
