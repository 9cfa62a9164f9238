"""What a run has written as MCAP, read back with rosbags, against what it has written beside it."""

import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.core.extras import MissingPackageError
from conformodal.geometry import Trajectory
from conformodal.io.streams import open_stream
from conformodal.io.streams.frames import Frame
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.results import read_region_records, read_trajectories
from conformodal.ros.bag import BagWriter
from conformodal.ros.conversion import TOPICS, RosError
from tests.helpers import run_ok

pytest.importorskip("rosbags")


def read(path):
    """Messages by topic, with their times in nanoseconds."""
    from rosbags.highlevel import AnyReader

    found = {}
    with AnyReader([path]) as reader:
        for connection in reader.connections:
            found[connection.topic] = []
        for connection, log_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            assert message.__msgtype__ == connection.msgtype
            found[connection.topic].append((log_ns, message))
    return found


def seconds(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


def position(pose):
    return [pose.position.x, pose.position.y, pose.position.z]


def angles(orientations, quats_wxyz):
    """Between ROS's and the project's, by SciPy alone."""
    theirs = Rotation.from_quat([[q.x, q.y, q.z, q.w] for q in orientations])
    ours = Rotation.from_quat(quats_wxyz, scalar_first=True)
    return (theirs * ours.inv()).magnitude()


@pytest.fixture(scope="module")
def recorded(small_world, tmp_path_factory):
    """A run on the test part, as files and as MCAP."""
    out = tmp_path_factory.mktemp("recorded")
    arguments = [small_world.model, small_world.folder, "--part", "test", "--limit", 240, "--out", out / "out"]
    run_ok("run", *arguments, "--save", out / "run.mcap", "--save-images")
    assert [path.name for path in out.iterdir() if path.name != "out"] == ["run.mcap"]  # nothing else stays
    return out / "out", out / "run.mcap"


def test_a_run_is_recorded_frame_by_frame(recorded):
    out, path = recorded
    records, found = read_region_records(out / "regions.jsonl"), read(path)
    assert set(found) == {f"/conformodal/{name}" for name in (*TOPICS, "truth", "image/compressed")}
    times = [record["timestamp_s"] for record in records]
    for name in ("pose", "candidates", "candidate_weights", "region", "status", "truth", "image/compressed"):
        log_s = [1e-9 * ns for ns, _ in found[f"/conformodal/{name}"]]
        np.testing.assert_allclose(log_s, times, atol=1e-6)
    for record, (ns, pose), (_, status) in zip(
        records, found["/conformodal/pose"], found["/conformodal/status"], strict=True
    ):
        assert seconds(pose.header.stamp) == pytest.approx(1e-9 * ns, abs=1e-9)
        assert pose.header.frame_id == "map"
        covariance = pose.pose.covariance.reshape(6, 6)
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0
        unknown = record["evidence"] == "unknown"
        assert (covariance[0, 0] == 1e6) == unknown
        values = {pair.key: pair.value for pair in status.status[0].values}
        assert values["evidence"] == record["evidence"]
        assert status.status[0].level == (2 if unknown else 0 if record["reliable"] else 1)


def test_poses_are_online_and_the_last_path_is_revised(recorded):
    out, path = recorded
    found, trajectories = read(path), read_trajectories(out)
    expected, hindsight = trajectories["online"], trajectories["hindsight"]
    last = found["/conformodal/path"][-1][1]
    known = [r["timestamp_s"] for r in read_region_records(out / "regions.jsonl") if r["evidence"] != "unknown"]
    kept = np.isin(np.round(expected.timestamps_s, 5), np.round(known, 5))
    assert len(last.poses) == kept.sum() > 40
    times = [seconds(pose.header.stamp) for pose in last.poses]
    np.testing.assert_allclose(times, expected.timestamps_s[kept], atol=1e-5)
    places = np.array([position(pose.pose) for pose in last.poses])
    said = [message.pose.pose for _, message in found["/conformodal/pose"] if message.pose.covariance[0] < 1e6]
    at_once = np.array([position(pose) for pose in said])
    np.testing.assert_allclose(at_once, expected.positions_xyz[kept], atol=1e-5)
    turned = angles([pose.orientation for pose in said], expected.orientations_quat_wxyz[kept])
    assert turned.max() < 1e-4
    revised, unrevised = (np.abs(each - hindsight.positions_xyz[kept]).mean() for each in (places, at_once))
    assert revised < 0.3 * unrevised  # not equal: the last poses are written before what follows revises them


def test_images_are_those_of_the_source(recorded, small_world):
    from conformodal.io import read_recording
    from conformodal.pipeline.store import load_model

    sequence, frames = read_recording(small_world.folder), load_model(small_world.model).split.test
    messages = read(recorded[1])["/conformodal/image/compressed"]
    _, first = messages[0]
    assert first.header.frame_id == "camera_optical_frame"
    seen = cv2.cvtColor(cv2.imdecode(first.data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    assert np.abs(seen.astype(int) - sequence.image(int(frames[0]))).mean() < 6
    stream = open_stream(recorded[1])  # such a recording is a source again
    assert stream.n_frames == len(messages)
    assert next(iter(stream)).image.shape == seen.shape


def test_lost_frames_and_recordings_apart(make_estimate, tmp_path):
    truth = Trajectory([0.0], [[1, 2, 3.0]], [[0.5, -0.5, 0.5, -0.5]])
    with BagWriter(tmp_path / "deep" / "a.mcap") as writer:
        for i, kind in enumerate([None, EvidenceType.GLOBAL, EvidenceType.UNKNOWN, None, EvidenceType.LANDMARKS]):
            writer.log(Frame(f"{i}", float(i), None, recording=i // 4), make_estimate(float(i), kind), truth)
    found = read(tmp_path / "deep" / "a.mcap")
    poses = [message.pose for _, message in found["/conformodal/pose"]]
    lost = [bool(np.array_equal(pose.covariance.reshape(6, 6), np.eye(6) * 1e6)) for pose in poses]
    assert lost == [True, False, True, True, False]
    assert all((position(pose.pose) == [0, 0, 0]) == gone for pose, gone in zip(poses, lost, strict=True))
    paths = [(ns, [p.header.stamp.sec for p in path.poses]) for ns, path in found["/conformodal/path"]]
    assert paths == [(10**9, [1]), (3 * 10**9, [1]), (4 * 10**9, [4]), (4 * 10**9, [4])]
    _, true = found["/conformodal/truth"][0]
    q = true.pose.orientation
    assert (q.x, q.y, q.z, q.w) == (-0.5, 0.5, -0.5, 0.5)
    assert "/conformodal/image/compressed" not in found


def test_what_cannot_be_written_is_named(make_estimate, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        BagWriter(tmp_path / "file" / "a.mcap")
    (tmp_path / "a.mcap").write_text("an earlier recording")
    writer = BagWriter(tmp_path / "a.mcap")
    writer.log(Frame("0", 1.0, None), make_estimate(1.0))
    with pytest.raises(RosError, match="a time of ROS"), writer:
        writer.log(Frame("1", -1.0, None), make_estimate(-1.0))
    assert (tmp_path / "a.mcap").read_text() == "an earlier recording"
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'conformodal\[ros\]'"):
        BagWriter(tmp_path / "b.mcap")
