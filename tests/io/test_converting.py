"""Conversions lose nothing in silence, and leave nothing by halves."""

from dataclasses import replace

import numpy as np
import pytest

from conformodal.geometry import PinholeCamera, Trajectory
from conformodal.io import DatasetError, Layout, read_recording
from conformodal.io.convert import convert_stream
from conformodal.io.streams.frames import Frame
from tests.helpers import contents, fill, run_ok
from tests.io.test_layouts import PLACES, WRITERS, N

pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")


def lose(layout, root, lost):
    """Take the poses of frames away."""
    if layout is Layout.SEVENSCENES:
        for i in lost:
            (root / "seq-01" / f"frame-{i:06d}.pose.txt").unlink()
        return
    path = next(p for p in root.rglob("*") if p.name in ("groundtruth.txt", "poses.tum"))
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_text("\n".join(line for i, line in enumerate(lines) if i not in lost) + "\n")


@pytest.mark.parametrize("layout", [Layout.TUM, Layout.IMAGES, Layout.SEVENSCENES])
def test_frames_with_a_pose_keep_it_and_the_others_are_named(tmp_path, layout):
    lost = (0, 1, 3)
    folder = WRITERS[layout](tmp_path / "a")
    names = [path.name for path in read_recording(folder).image_paths]
    lose(layout, tmp_path / "a", lost)
    result = run_ok("data", "convert", folder, "--out", tmp_path / "b")
    for i in lost:
        assert names[i] in result.output
    kept = [i for i in range(N) if i not in lost]
    after = read_recording(tmp_path / "b")
    np.testing.assert_allclose(after.require_truth().positions_xyz, PLACES[kept], atol=1e-6)
    assert [int(after.image(k)[0, 0, 0]) for k in range(len(kept))] == [10 * i for i in kept]
    whole = read_recording(tmp_path / "b", require_poses=False)
    assert [int(whole.image(k)[0, 0, 0]) for k in range(len(whole))] == [10 * i for i in range(N)]
    np.testing.assert_array_equal(whole.poses.timestamps_s, after.timestamps_s)


# camera axes, as columns, in those of the body
BODIES = {"flu": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], "forward-right-down": [[0, 0, 1], [1, 0, 0], [0, 1, 0]]}


@pytest.mark.parametrize("body", BODIES)
def test_poses_of_bodies_become_those_of_cameras(tmp_path, body):
    folder = WRITERS[Layout.TUM](tmp_path / "a")
    before = read_recording(folder).require_truth().poses_se3
    run_ok("data", "convert", folder, "--out", tmp_path / "b", "--axes", body)
    after = read_recording(tmp_path / "b").require_truth().poses_se3
    np.testing.assert_allclose(after[:, :3, :3], before[:, :3, :3] @ np.array(BODIES[body]), atol=1e-6)
    np.testing.assert_allclose(after[:, :3, 3], before[:, :3, 3], atol=1e-9)


@pytest.mark.parametrize("world_axes", ["y,x,-z", "x,-z,y"])
def test_positions_are_turned_and_inverse_poses_inverted(tmp_path, world_axes):
    folder = WRITERS[Layout.TUM](tmp_path / "a")
    back = np.linalg.inv(read_recording(folder).require_truth().poses_se3)
    turned = {"y,x,-z": back[:, [1, 0, 2], 3] * (1, 1, -1), "x,-z,y": back[:, [0, 2, 1], 3] * (1, -1, 1)}
    run_ok("data", "convert", folder, "--out", tmp_path / "b", "--world-to-camera", "--world-axes", world_axes)
    after = read_recording(tmp_path / "b").require_truth().poses_se3
    np.testing.assert_allclose(after[:, :3, 3], turned[world_axes], atol=1e-6)
    np.testing.assert_allclose(after[:, :3, :3], back[:, :3, :3], atol=1e-6)


class Failing:
    """A stream that fails after some frames."""

    name, camera, live, n_frames = "failing", PinholeCamera(40, 40, 32, 24, 64, 48), False, None

    def __init__(self, error, after=3, times=None):
        self.error, self.after, self.times = error, after, times

    def __iter__(self):
        for i in range(self.after):
            time_s = 0.1 * i if self.times is None else self.times[i]
            yield Frame(f"f{i}", time_s, np.full((48, 64, 3), i, np.uint8))
        if self.error is not None:
            raise self.error


def poses_for(n=9):
    return Trajectory(0.1 * np.arange(n), np.arange(3.0 * n).reshape(n, 3), np.tile([1.0, 0, 0, 0], (n, 1)))


@pytest.mark.parametrize(
    ("error", "there"),
    [(OSError(28, "No space left on device"), False), (KeyboardInterrupt(), True), (DatasetError("breaks off"), True)],
)
def test_a_failure_leaves_nothing(tmp_path, error, there):
    out = tmp_path / "out"
    if there:
        out.mkdir()
    stream = Failing(error)
    with pytest.raises(DatasetError if isinstance(error, OSError) else type(error)):
        convert_stream(out, stream, stream.camera, poses_for())
    assert [p.name for p in tmp_path.rglob("*")] == (["out"] if there else [])
    stream = Failing(None)
    assert convert_stream(out, stream, stream.camera, poses_for()).n_frames == 3
    assert len(read_recording(out)) == 3


UNUSABLE = {
    "a folder that is full": ("full", "not empty"),
    "a file": ("file", "is a file"),
    "below a file": ("file/out", "cannot be written"),
    "below a device": ("/dev/null/out", "cannot be written"),
}


@pytest.mark.parametrize("what", UNUSABLE)
def test_unwritable_output_is_refused_before_any_image(tmp_path, what):
    out, match = UNUSABLE[what]
    fill(tmp_path, {"full/mine": "mine", "file": "mine"})
    before = [contents(tmp_path), sorted(tmp_path.rglob("*"))]
    stream, progress = Failing(None), []
    with pytest.raises(DatasetError, match=match):
        convert_stream(tmp_path / out, stream, stream.camera, poses_for(), progress.append)
    assert progress == []
    assert [contents(tmp_path), sorted(tmp_path.rglob("*"))] == before


def test_poses_of_another_time_leave_nothing(tmp_path):
    stream = Failing(None)
    late = replace(poses_for(), timestamps_s=900 + np.arange(9.0))
    with pytest.raises(DatasetError, match="no frame has a pose"):
        convert_stream(tmp_path / "out", stream, stream.camera, late)
    assert not list(tmp_path.iterdir())
