"""Poses in ROS recordings, against the motion that they were written from."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.io import read_recording
from tests.helpers import refusal, run_ok
from tests.io.streams.test_streams import camera_info, messages, write_bag

TIMES = np.arange(99.9, 102.8, 0.05)
IMAGE_TIMES = 100 + 0.5 * np.arange(6)
# of the camera (x right, y down) on a robot (x ahead, z up)
MOUNT = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0.02], [0, -1, 0, 0.3], [0, 0, 0, 1.0]])


def motion(t):
    """T_world_robot: one metre per second along x, turning left."""
    pose = np.eye(4)
    pose[:3, :3], pose[0, 3] = Rotation.from_euler("z", 0.2 * (t - 100)).as_matrix(), t - 100
    return pose


def parts(store, pose, t, frame):
    types = store.types
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    extra = {"seq": 0} if "seq" in header.__dataclass_fields__ else {}
    head = header(stamp=stamp(sec=int(t), nanosec=round((t % 1) * 1e9)), frame_id=frame, **extra)
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    return head, dict(zip("xyz", pose[:3, 3].tolist(), strict=True)), turn


def posed(store, kind, pose, t, child, parent="odom"):
    types = store.types
    head, at, turn = parts(store, pose, t, parent)
    if kind.endswith(("TransformStamped", "TFMessage")):
        transform = types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](**at), rotation=turn
        )
        one = types["geometry_msgs/msg/TransformStamped"](header=head, child_frame_id=child, transform=transform)
        return types[kind](transforms=[one]) if kind.endswith("TFMessage") else one
    pose = types["geometry_msgs/msg/Pose"](position=types["geometry_msgs/msg/Point"](**at), orientation=turn)
    if kind.endswith("PoseStamped"):
        return types[kind](header=head, pose=pose)
    unsure = types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
    if kind.endswith("PoseWithCovarianceStamped"):
        return types[kind](header=head, pose=unsure)
    zero = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    still = types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
    return types[kind](header=head, child_frame_id=child, pose=unsure, twist=still)


TF, PATH = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Path"


def write_posed(path, sent, ros1=False):
    """A bag of six images of the frame ``cam``, and of `sent`: topic, kind, pose of a time, child, parent, times."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    writer = Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    images = messages(store)
    every = [(99.0, "/cam/camera_info", camera_info(store, images[0][0]))]
    every += [(t, "/cam/image_raw", its) for t, (_, its) in zip(IMAGE_TIMES, images, strict=True)]
    for topic, kind, pose_of, child, parent, times in sent:
        each = "geometry_msgs/msg/PoseStamped" if kind == PATH else kind
        frame = "cam" if kind == PATH else parent  # some name the camera in the poses, and the world above them
        poses = [posed(store, each, pose_of(t), t, child, frame) for t in times]
        if kind == PATH:  # repeats its poses, and corrects them at last
            head = parts(store, np.eye(4), times[-1], parent)[0]
            wrong = [posed(store, each, np.eye(4), t, child, frame) for t in times]
            poses = [store.types[PATH](header=head, poses=some) for some in [wrong] * (len(poses) - 1) + [poses]]
        every += [(t, topic, pose) for t, pose in zip(times, poses, strict=True)]
    with writer:
        to = {}
        for t, topic, message in sorted(every, key=lambda its: its[0]):
            kind = message.__msgtype__
            if topic not in to:
                to[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(to[topic], round(t * 1e9), serialize(message, kind))
    return path


def converted(path, out, *arguments):
    result = run_ok("data", "convert", path, "--out", out, *arguments)
    return read_recording(out), " ".join(result.output.split())


def check(sequence, pose_of):
    np.testing.assert_allclose(sequence.truth.poses_se3, [pose_of(t) for t in IMAGE_TIMES], atol=2e-4)
    assert (sequence.camera.fx, sequence.camera.fy) == (40, 41)


@pytest.mark.parametrize("ros1", [False, True])
@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("nav_msgs/msg/Odometry", "of cam in odom"),
        ("geometry_msgs/msg/TransformStamped", "of cam in odom"),
        ("nav_msgs/msg/Path", "taken as those of the camera"),
        ("geometry_msgs/msg/PoseStamped", "taken as those of the camera"),
        ("geometry_msgs/msg/PoseWithCovarianceStamped", "taken as those of the camera"),
    ],
)
def test_poses_of_the_camera_are_interpolated_at_the_images(tmp_path, kind, told, ros1):
    path = tmp_path / ("a.bag" if ros1 else "a")
    write_posed(path, [("/pose", kind, motion, "/cam" if ros1 else "cam", "odom", TIMES + 0.013)], ros1)
    sequence, output = converted(path, tmp_path / "out", "--poses", "/pose")
    check(sequence, motion)
    assert told in output


STATIC = [
    ("/tf_static", TF, lambda _: MOUNT, "cam", "base_link", [99.0]),
    ("/tf_static", TF, lambda _: np.eye(4), "lidar", "base_link", [99.1]),
]


def test_poses_of_the_robot_are_moved_to_its_camera(tmp_path):
    odometry = ("/odom", "nav_msgs/msg/Odometry", motion, "base_link", "odom", TIMES)
    path = write_posed(tmp_path / "a", [odometry, *STATIC])
    sequence, output = converted(path, tmp_path / "out", "--poses", "/odom")
    check(sequence, lambda t: motion(t) @ MOUNT)
    assert "/odom: of cam in odom, through base_link" in output
    late, _ = converted(path, tmp_path / "late", "--poses", "/odom", "--time-offset", "0.1")
    check(late, lambda t: motion(t - 0.1) @ MOUNT)


@pytest.mark.parametrize("static", [[], STATIC[1:]])
def test_poses_not_connected_to_the_camera_are_refused(tmp_path, static):
    odometry = ("/odom", "nav_msgs/msg/Odometry", motion, "base_link", "odom", TIMES)
    path = write_posed(tmp_path / "a", [odometry, *static])
    result = refusal("data", "convert", path, "--poses", "/odom", "--out", tmp_path / "out")
    assert "leads from odom to base_link, and not to 'cam', which the images are of" in result
    assert ("there is no /tf_static" in result) is (not static)
    assert not (tmp_path / "out").exists()


def test_transforms_lead_from_the_world_to_the_camera(tmp_path):
    def drift(t):
        pose = np.eye(4)
        pose[1, 3] = 0.1 * (t - 100)
        return pose

    slow = ("/tf", TF, drift, "odom", "map", np.arange(99.8, 103, 0.1))
    fast = ("/tf", TF, motion, "base_link", "odom", TIMES)
    path = write_posed(tmp_path / "a", [slow, fast, *STATIC])
    sequence, output = converted(path, tmp_path / "out", "--poses", "/tf")
    check(sequence, lambda t: drift(t) @ motion(t) @ MOUNT)
    assert "/tf: of cam in map, through odom, through base_link" in output
    alone = write_posed(tmp_path / "b", [fast])
    result = refusal("data", "convert", alone, "--poses", "/tf", "--out", tmp_path / "no")
    assert "leads from odom to base_link, and not to 'cam'" in result


def beside(t):
    return np.array([[1, 0, 0, 0], [0, 1, 0, 9], [0, 0, 1, 0], [0, 0, 0, 1.0]]) @ motion(t)


@pytest.mark.parametrize("topic", ["/o", "/tf"])
def test_poses_in_two_worlds_are_refused(tmp_path, topic):
    kind = TF if topic == "/tf" else "nav_msgs/msg/Odometry"
    few = (topic, kind, beside, "cam", "map", [99.8, 100.01])
    path = write_posed(tmp_path / "a", [few, (topic, kind, motion, "cam", "odom", TIMES)])
    result = refusal("data", "convert", path, "--poses", topic, "--out", tmp_path / "out")
    assert "has poses of cam in map and in odom" in result


def test_a_topic_without_poses_is_named(tmp_path):
    path = write_posed(tmp_path / "a", [("/o", "nav_msgs/msg/Odometry", motion, "cam", "odom", TIMES), *STATIC])
    result = refusal("data", "convert", path, "--poses", "/imu", "--out", tmp_path / "out")
    assert result.endswith("holds no poses on /imu, which is no file either; there are /o")


@pytest.mark.parametrize("kind", ["mcap", "ros1"])
def test_training_on_a_bag_names_the_convert_command(tmp_path, kind):
    path = write_bag(tmp_path / ("a.bag" if kind == "ros1" else "a"), kind)
    result = refusal("train", path, "--out", tmp_path / "model")
    assert f"conformodal data convert {path} --poses POSES --out FOLDER" in result
