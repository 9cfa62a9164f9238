"""The node in the place of AMCL: transforms, diagnostics and initial poses, on a recording of a robot that drives."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from conformodal.core.extras import MissingPackageError
from conformodal.io import read_recording
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.store import load_model
from conformodal.ros.conversion import NANOSECONDS, Conversion, rosbags_factory
from conformodal.ros.node import PoseNode
from conformodal.ros.parameters import Parameters
from tests.ros.test_map_to_odom import T_BASE_CAM, matrix, stamp_ns
from tests.ros.test_node import START, image_message, lost, said
from tests.ros.test_transforms import random_transform

pytest.importorskip("rosbags")

IMAGE, TF = "sensor_msgs/msg/Image", "tf2_msgs/msg/TFMessage"
STEP_NS = NANOSECONDS // 10
UNSEEN = range(20, 26)  # frames of the recording that show nothing
MODULE_M = 4.0  # of the corridor, whose rooms look alike


@pytest.fixture(scope="module")
def world(small_world):
    return read_recording(small_world.folder), load_model(small_world.model)


@pytest.fixture
def running(ros, world):
    ros.buffer.set("base_link", "camera", T_BASE_CAM)
    node = ros.make_node({})
    sequence, model = world

    def show(frame, stamp, **given):
        node.subscribed["image"][1](image_message(ros, sequence.image(frame), stamp, **given))

    return SimpleNamespace(ros=ros, node=node, sequence=sequence, live=PoseNode(node, VisualOdometry(model)), show=show)


def image_of(make, image, stamp):
    header = Conversion(make=make).header(stamp, "camera")
    height, width, _ = image.shape
    given = {"height": height, "width": width, "encoding": "rgb8", "is_bigendian": 0, "step": 3 * width}
    return make(IMAGE, header=header, data=np.frombuffer(image.tobytes(), np.uint8), **given)


def write_robot(path, sequence, T_map_odom, n):
    """A recording of images of a camera on a robot, of its odometry, which began elsewhere, and of its mounting."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, make = get_typestore(Stores.ROS2_HUMBLE), rosbags_factory()
    parent = {"odom": Conversion("odom", make), "base_link": Conversion("base_link", make)}

    def transforms(stamp, frame, child, T):
        return make(TF, transforms=[parent[frame].transform(stamp, child, T)])

    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        kinds = {"/camera/image_raw": IMAGE, "/tf": TF, "/tf_static": TF}
        to = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}

        def write(topic, stamp, message):
            writer.write(to[topic], stamp, store.serialize_cdr(message, kinds[topic]))

        write("/tf_static", START - 1, transforms(START - 1, "base_link", "camera", T_BASE_CAM))
        for i in range(n):
            stamp = START + i * STEP_NS
            T_map_base = sequence.truth.poses_se3[i] @ np.linalg.inv(T_BASE_CAM)
            write("/tf", stamp, transforms(stamp, "odom", "base_link", np.linalg.inv(T_map_odom) @ T_map_base))
            image = np.zeros_like(sequence.image(i)) if i in UNSEEN else sequence.image(i)
            write("/camera/image_raw", stamp, image_of(make, image, stamp))


def test_map_to_odom_and_odometry_give_the_camera_pose(ros, world, tmp_path):
    from rosbags.highlevel import AnyReader

    (sequence, model), T_map_odom = world, random_transform(np.random.default_rng(0))
    write_robot(tmp_path / "bag", sequence, T_map_odom, 32)
    node = ros.make_node({})
    PoseNode(node, VisualOdometry(model))
    stamps, found = [], []
    with AnyReader([tmp_path / "bag"]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype == TF:
                ros.buffer.set_message(message.transforms[0], connection.topic == "/tf_static")
                continue
            n_sent = len(sent(node))
            node.subscribed["image"][1](message)
            stamps.append(stamp_ns(message))
            node.timers["on_status"][1]()
            found.append(sent(node)[-1] if len(sent(node)) > n_sent else None)
    levels = [message.status[0].level for message in diagnostics(node)]
    reliable = [i for i, level in enumerate(levels) if level == b"\0"]
    assert len(reliable) > 15
    assert not set(reliable) & set(UNSEEN)
    for i in reliable:
        assert stamp_ns(found[i]) == stamps[i] + NANOSECONDS
        pose = said(node)[i].pose.pose
        T_map_cam = matrix(SimpleNamespace(translation=pose.position, rotation=pose.orientation))
        T_odom_base = np.linalg.inv(T_map_odom) @ sequence.truth.poses_se3[i] @ np.linalg.inv(T_BASE_CAM)
        np.testing.assert_allclose(matrix(found[i].transform) @ T_odom_base @ T_BASE_CAM, T_map_cam, atol=1e-6)
    off_m = [np.linalg.norm(matrix(found[i].transform)[:3, 3] - T_map_odom[:3, 3]) for i in reliable]
    assert np.median(off_m) < 0.3  # the camera is 5 m from where odometry began, so that a degree is 0.1 m
    before = max(i for i in reliable if i < UNSEEN[0])
    for i in UNSEEN:
        assert lost(said(node)[i])
        np.testing.assert_array_equal(matrix(found[i].transform), matrix(found[before].transform))
        assert stamp_ns(found[i]) == stamps[i] + NANOSECONDS
        text = diagnostics(node)[i].status[0].message
        assert text.startswith(f"standing still since {0.1 * (i - before):.1f} s: ")


def sent(node):
    return [message for topic, message in node.said if topic == "/tf"]


def diagnostics(node):
    return [message for topic, message in node.said if topic == "/diagnostics"]


def put_odometry(running, stamp):
    running.ros.buffer.set("odom", "base_link", np.eye(4), stamp)


def test_the_transform_is_sent_again_when_no_image_comes(running):
    node = running.node
    period_s, on_refresh = node.timers["on_refresh"]
    assert period_s == 0.25  # a quarter of the tolerance
    on_refresh()
    assert sent(node) == []
    node.now_ns = 7 * NANOSECONDS  # not the clock of the images
    for i in range(6):
        stamp = START + i * STEP_NS
        put_odometry(running, stamp)
        running.show(i, stamp)
    n = len(sent(node))
    assert n > 0
    for seconds, more in ((0.2, 0), (0.3, 1), (1.1, 2)):
        node.now_ns = round((7 + seconds) * NANOSECONDS)
        on_refresh()
        assert len(sent(node)) == n + more
    assert stamp_ns(sent(node)[-1]) == START + 5 * STEP_NS + round(2.1 * NANOSECONDS)
    node.timers["on_time"][1]()
    node.timers["on_status"][1]()
    assert diagnostics(node)[-1].status[0].message.endswith("s: no image for 1 s")
    assert stamp_ns(diagnostics(node)[-1]) == node.now_ns


def test_late_odometry_is_waited_for(running):
    """The mounting of the camera, which is known, is not waited for."""
    node, waited_s = running.node, running.ros.buffer.waited_s
    for i in range(6):
        running.show(i, START + i * STEP_NS)
    assert set(waited_s) == {0.0, 0.1}  # the mounting is known, odometry is not
    node.timers["on_status"][1]()
    assert diagnostics(node)[-1].status[0].level == b"\2"
    assert "no transform from base_link to odom" in diagnostics(node)[-1].status[0].message
    assert sent(node) == []
    put_odometry(running, START + 6 * STEP_NS)
    waited_s.clear()
    running.show(6, START + 6 * STEP_NS)
    assert set(waited_s) == {0.1}
    assert len(sent(node)) == 1


def test_images_without_a_frame_are_named(running):
    put_odometry(running, START)
    for i in range(4):
        running.show(i, START + i * STEP_NS, frame_id="")
    running.node.timers["on_status"][1]()
    assert "name no frame_id" in diagnostics(running.node)[-1].status[0].message
    assert not said(running.node, "base_pose")


def test_a_clock_that_is_set_back_forgets_odometry(running):
    for i in range(6):
        put_odometry(running, START + i * STEP_NS)
        running.show(i, START + i * STEP_NS)
    assert sent(running.node)
    n = len(sent(running.node))
    running.show(0, START - 60 * NANOSECONDS)
    assert len(sent(running.node)) == n
    assert "odom" not in [frame for frame, _ in running.ros.buffer.parents.values()]


def initial_pose(running, T_map_cam, frame="map", orientation=None, deviation_m=0.5):
    """What RViz publishes, for the base of a camera at a pose."""
    make = Conversion(frame, lambda kind, **given: running.ros.messages.of(kind)(**given))
    pose = make.pose_of(T_map_cam @ np.linalg.inv(T_BASE_CAM))
    pose.orientation = pose.orientation if orientation is None else orientation
    covariance = np.diag([deviation_m**2, deviation_m**2, 0, 0, 0, np.radians(15) ** 2])
    running.node.subscribed["initialpose"][1](make.uncertain(make.header(0), pose, covariance))


def moved(sequence, frame, along_m, off_m=0.0):
    T = sequence.truth.poses_se3[frame].copy()
    T[:2, 3] += along_m, off_m
    return T


def along(message):
    return message.pose.pose.position.x


@pytest.mark.parametrize("module", [0, 1, 2])
def test_of_rooms_that_look_alike_the_initial_pose_chooses_one(running, module):
    frame, at = 26, running.sequence.truth.positions_xyz[26, 0] + MODULE_M * module
    initial_pose(running, moved(running.sequence, frame, MODULE_M * module + 0.2))
    running.show(frame, START)
    assert along(said(running.node)[-1]) == pytest.approx(at, abs=0.3)
    assert said(running.node)[-1].pose.covariance[0] < 0.5
    assert running.node.logged[-1][1].startswith("initial pose: the path begins anew")
    running.show(frame + 1, START + STEP_NS)
    assert along(said(running.node)[-1]) == pytest.approx(at, abs=0.3)
    assert len(running.node.logged) == 1  # an initial pose is used once


def test_an_initial_pose_is_used_when_sim_time_starts(running):
    initial_pose(running, moved(running.sequence, 26, 0.2))
    running.show(26, STEP_NS // 4)
    [path] = said(running.node, "path")
    stamps = [pose.header.stamp.nanosec for pose in path.poses]
    assert stamps == [STEP_NS // 4]
    assert running.node.logged[-1][1].startswith("initial pose: the path begins anew")


def test_an_initial_pose_begins_a_path_without_it(running):
    for i in range(8):
        running.show(i, START + i * STEP_NS)
    initial_pose(running, moved(running.sequence, 26, 0.2))
    running.show(26, START + 8 * STEP_NS)
    (pose,) = said(running.node, "path")[-1].poses
    stamp = pose.header.stamp
    assert stamp.sec * NANOSECONDS + stamp.nanosec == pytest.approx(START + 8 * STEP_NS, abs=1000)  # seconds are floats


def test_images_overrule_an_initial_pose_that_fits_none_of_them(running):
    initial_pose(running, moved(running.sequence, 15, 0, off_m=3.0))
    for i in range(5):
        running.show(15 + i, START + i * STEP_NS)
    assert along(said(running.node)[-1]) == pytest.approx(running.sequence.truth.positions_xyz[19, 0], abs=0.3)


def test_unusable_initial_poses_are_named_and_ignored(running):
    other = PoseNode(running.ros.make_node({}), VisualOdometry(running.live.odometry.model))
    orientation = running.ros.messages.of("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=0.0)
    T = moved(running.sequence, 26, MODULE_M)
    for i, (given, parents) in enumerate([({"frame": "odom"}, 1), ({"orientation": orientation}, 1), ({}, 0)]):
        if not parents:
            running.ros.buffer.parents.clear()
        initial_pose(running, T, **given)
        running.show(26 + i, START + i * STEP_NS)
        other.on_image(image_message(running.ros, running.sequence.image(26 + i), START + i * STEP_NS))
    texts = [text for level, text in running.node.logged if level == "warning"]
    for text, named in zip(texts, ("frame 'odom'", "a rotation", "no transform from camera"), strict=True):
        assert text.startswith("initial pose is not used: ")
        assert named in text
    mine, its = ([along(message) for message in said(node)] for node in (running.node, other._node))
    assert mine == its


def test_a_model_of_the_papers_method_takes_no_initial_pose(ros):
    node = ros.make_node({})
    PoseNode(node, SimpleNamespace(reset=lambda: None))
    initial_pose(SimpleNamespace(ros=ros, node=node), np.eye(4))
    assert node.logged == [("warning", "initial pose is not used: a model of the paper's method takes none")]


def test_without_tf2_the_node_says_what_is_missing(ros, monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(MissingPackageError, match="the node needs tf2_ros, which comes with ROS 2"):
        PoseNode(ros.make_node({}), SimpleNamespace(reset=lambda: None))


def test_the_base_of_another_name_is_looked_up(ros, world):
    ros.buffer.set("torso", "camera", T_BASE_CAM)
    node, (sequence, model) = ros.make_node({}), world
    PoseNode(node, VisualOdometry(model), Parameters(base_frame="torso", world_frame="hall", publish_tf=False))
    node.subscribed["image"][1](image_message(ros, sequence.image(0), START))
    [base], [camera] = said(node, "base_pose"), said(node)
    assert base.header.frame_id == "hall"
    poses = [matrix(SimpleNamespace(translation=m.pose.pose.position, rotation=m.pose.pose.orientation))
                  for m in (base, camera)]  # fmt: skip
    np.testing.assert_allclose(poses[0] @ T_BASE_CAM, poses[1], atol=1e-9)
