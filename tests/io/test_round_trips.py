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
from conformodal.io.convert import WRITABLE, write_layout
from conformodal.io.streams.frames import RecordingStream

SIZE = (64, 48)
LENSES = [(), (-0.1, 0.02, 0.001, 0.002), (-0.1, 0.02, 0.001, 0.002, 0.003)]
pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")


@st.composite
def sources(draw, n_recordings=1):
    """A data set without its images: times with gaps, any poses, some of them unknown, any camera."""
    counts = draw(st.lists(st.integers(2, 5), min_size=n_recordings, max_size=n_recordings))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rate = draw(st.sampled_from([7.5, 10.0, 24.0, 30.0]))
    times, start = [], draw(st.sampled_from([0.0, 5.25, 1305031102.175304]))
    for n in counts:
        steps = np.append(rng.integers(1, 4, n - 1), 1)
        steps[0] = 1  # the usual step occurs
        times.append(start + np.concatenate(([0], np.cumsum(steps[:-1]))) / rate)
        start = times[-1][-1] + 10
    n = sum(counts)
    poses = Trajectory(
        np.concatenate(times), 10 ** rng.uniform(-3, 3) * rng.normal(size=(n, 3)), rng.normal(size=(n, 4))
    )
    f, c = rng.uniform(30, 200), rng.uniform(0.4, 0.6, 2) * SIZE
    camera = PinholeCamera(f, f * rng.uniform(0.9, 1.1), *c.tolist(), *SIZE, LENSES[draw(st.integers(0, 2))])
    known = rng.random(n) < draw(st.sampled_from([0.5, 1.0]))
    known[0] = True
    recording = np.repeat(np.arange(n_recordings), counts)
    return poses, recording, camera, known


def stored(folder, source):
    """The source as a data set with images; and its known poses."""
    poses, recording, camera, known = source
    paths = []
    for i in range(len(poses)):
        paths.append(folder / f"{'zyxwvutsrqponmlkjihgfedcba'[i]}.{('png', 'jpg')[i % 2]}")  # no order in the names
        Image.new("RGB", SIZE, (5 * i, 0, 0)).save(paths[-1])
    return Recording("a", tuple(paths), poses.timestamps_s, recording, camera), poses[np.flatnonzero(known)]


def within(times, recording):
    """Times from the start of each recording."""
    return np.concatenate([times[recording == k] - times[recording == k][0] for k in np.unique(recording)])


def check_round_trip(source, layout):
    known = source[3]
    with tempfile.TemporaryDirectory() as scratch:
        before, truth = stored(Path(scratch), source)
        done = write_layout(Path(scratch) / "b", layout, RecordingStream(before), before.camera, truth, max_gap_s=0)
        after = read_recording(Path(scratch) / "b", require_poses=False)
        assert (done.n_frames, done.n_posed) == (len(known), known.sum())
        reds = [after.image(i)[0, 0, 0] for i in range(len(after))]
        np.testing.assert_allclose(reds, 5 * np.arange(len(known)), atol=2)  # JPEG
    recording = before.recording
    np.testing.assert_array_equal(after.recording, recording)
    # a double of 2026 has 2e-7 s
    digits = 1e-6 if before.timestamps_s[0] > 1e9 else 2e-9
    np.testing.assert_allclose(
        within(after.timestamps_s, recording), within(before.timestamps_s, recording), atol=digits, rtol=0
    )
    np.testing.assert_array_equal(np.isin(after.timestamps_s, after.poses.timestamps_s), known)
    scale = np.abs(truth.positions_xyz).max()
    np.testing.assert_allclose(after.poses.positions_xyz, truth.positions_xyz, atol=1e-12 * scale, rtol=0)
    np.testing.assert_allclose(after.poses.poses_se3[:, :3, :3], truth.poses_se3[:, :3, :3], atol=1e-12)
    assert after.camera == before.camera


few = settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@pytest.mark.parametrize("layout", WRITABLE)
@given(source=sources())
@few
def test_what_is_written_is_read_back(layout, source):
    check_round_trip(source, layout)
