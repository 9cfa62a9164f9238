"""The node with the stand-in for rclpy of conftest.py, whose messages are as strict about types as ROS's own."""

import sys
from array import array
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from conformodal.core.extras import MissingPackageError
from conformodal.io import read_recording
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.store import load_model
from conformodal.ros import node as node_module
from conformodal.ros.conversion import NANOSECONDS, TOPICS, Conversion
from conformodal.ros.node import PoseNode, message_class

pytest.importorskip("rosbags")


def image_message(ros, image, stamp_ns, encoding="rgb8", frame_id="camera"):
    of = ros.messages.of
    sec, nanosec = divmod(stamp_ns, NANOSECONDS)
    stamp = of("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)
    header = of("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id)
    height, width, _ = image.shape
    data = array("B", image.tobytes())
    return of("sensor_msgs/msg/Image")(
        header=header, height=height, width=width, encoding=encoding, step=3 * width, data=data
    )


def info_message(ros, camera, **changed):
    d, k = array("d", camera.distortion), camera.matrix.ravel()
    given = {"width": camera.width, "height": camera.height, "k": k, "d": d, "distortion_model": "plumb_bob", **changed}
    return ros.messages.of("sensor_msgs/msg/CameraInfo")(**given)


@pytest.fixture(scope="module")
def world(small_world):
    return read_recording(small_world.folder), load_model(small_world.model)


@pytest.fixture
def running(ros, world):
    node = ros.make_node({})
    return SimpleNamespace(ros=ros, node=node, sequence=world[0], live=PoseNode(node, VisualOdometry(world[1])))


def said(node, name="pose"):
    return [message for topic, message in node.said if topic == f"/conformodal/{name}"]


def lost(message):
    return message.pose.covariance[0] == 1e6 and message.pose.pose.position.x == 0


START = 1_700_000_000_123_456_789


def test_the_node_answers_as_the_estimator_does(running, world):
    node, ros = running.node, running.ros
    stamps = [START + i * NANOSECONDS // 10 for i in range(12)]
    _, callback = node.subscribed["image"]
    for i, stamp_ns in enumerate(stamps):
        callback(image_message(ros, running.sequence.image(i), stamp_ns))
    odometry, conversion, levels = VisualOdometry(world[1]), Conversion(), []
    assert {topic for topic, _ in node.said} == {f"/conformodal/{name}" for name in TOPICS}  # no transform is known
    for i, (stamp_ns, message) in enumerate(zip(stamps, said(node), strict=True)):
        sec, nanosec = divmod(stamp_ns, NANOSECONDS)
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == (sec, nanosec)
        expected = conversion.messages(odometry.step(running.sequence.image(i), sec + nanosec / NANOSECONDS), stamp_ns)
        np.testing.assert_allclose(message.pose.covariance, expected["pose"].pose.covariance, rtol=1e-4, atol=1e-9)
        q, own = message.pose.pose.orientation, expected["pose"].pose.pose.orientation
        np.testing.assert_allclose([q.x, q.y, q.z, q.w], [own.x, own.y, own.z, own.w], atol=1e-6)
        levels.append(expected["status"].status[0].level.to_bytes(1, "big"))
    assert len(said(node, "path")) == 2  # of every tenth
    assert [message.status[0].level for message in said(node, "status")] == levels
    assert set(levels) <= {b"\0", b"\1"}  # never lost; the first place may be one of several


def test_a_frozen_image_loses_the_pose_until_it_changes(running):
    node, ros, taken = running.node, running.ros, [0, 1, 2, 3, 3, 3, 3, 4]
    for i, frame in enumerate(taken):
        stamp_ns = START + i * NANOSECONDS // 20  # a single repeat may be a slower camera
        node.subscribed["image"][1](image_message(ros, running.sequence.image(frame), stamp_ns))
    assert [lost(message) for message in said(node)] == [False] * 5 + [True, True, False]
    assert "repeats the picture of image of" in said(node, "status")[6].status[0].message


def test_where_no_image_comes_the_pose_is_lost(running):
    node, ros = running.node, running.ros
    period_s, on_time = node.timers["on_time"]
    assert period_s == 1.0
    node.now_ns = START
    on_time()  # before the first
    node.subscribed["image"][1](image_message(ros, running.sequence.image(0), START))
    node.now_ns += NANOSECONDS // 2
    on_time()
    assert [lost(message) for message in said(node)] == [True, False]
    node.now_ns += NANOSECONDS
    on_time()
    last = said(node)[-1]
    assert lost(last)
    assert last.header.stamp.sec * NANOSECONDS + last.header.stamp.nanosec == node.now_ns
    assert "no image for 1 s" in said(node, "status")[-1].status[0].message
    assert said(node, "status")[-1].status[0].level == b"\2"


def test_a_camera_of_another_kind_is_refused_until_it_fits(running):
    node, ros, camera = running.node, running.ros, running.sequence.camera
    _, on_info = node.subscribed["camera_info"]
    other = camera.matrix.ravel() * [1.5, 1, 1, 1, 1.5, 1, 1, 1, 1]
    fisheye = {"distortion_model": "equidistant", "d": array("d", [0.1] * 4)}
    for stamp, info in enumerate([{"k": other}, {"k": other}, fisheye, {}]):
        on_info(info_message(ros, camera, **info))
        node.subscribed["image"][1](image_message(ros, running.sequence.image(stamp), START + stamp * NANOSECONDS))
    assert [lost(message) for message in said(node)] == [True, True, True, False]
    assert [level for level, _ in node.logged] == ["error", "error"]  # each once
    assert "the model was trained with" in said(node, "status")[0].status[0].message
    assert "equidistant" in said(node, "status")[2].status[0].message


def test_images_that_cannot_be_used_cost_that_image(running):
    node, ros, image = running.node, running.ros, running.sequence.image(0)
    on_image = node.subscribed["image"][1]
    on_image(image_message(ros, image, START))
    on_image(image_message(ros, image, START + NANOSECONDS // 2, encoding="jpeg2000"))
    on_image(image_message(ros, image[:50], START + NANOSECONDS))
    on_image(image_message(ros, image, START + 2 * NANOSECONDS))
    assert [lost(message) for message in said(node)] == [False, True, True, False]
    texts = [message.status[0].message for message in said(node, "status")]
    assert "jpeg2000" in texts[1]
    assert "expected uint8" in texts[2]


def test_late_images_are_dropped_and_a_clock_reset_restarts(running):
    node, ros, image = running.node, running.ros, running.sequence.image(0)
    on_image = node.subscribed["image"][1]
    for seconds in (10.0, 9.5, 10.0, 3.0):
        on_image(image_message(ros, image, int(seconds * NANOSECONDS)))
    assert [message.header.stamp.sec for message in said(node)] == [10, 3]
    assert [level for level, _ in node.logged] == ["warning", "warning", "info"]
    assert [len(path.poses) for path in said(node, "path")] == [1, 1]


def test_the_program_loads_a_model_and_spins(ros, small_world, world, capsys):
    ros.given = {"model": str(small_world.model), "world_frame": "hall", "compressed": True}

    def spin(node):
        kind, _ = node.subscribed["image"]
        assert kind is ros.messages.of("sensor_msgs/msg/CompressedImage")
        node.timers["on_time"][1]()
        raise KeyboardInterrupt

    ros.spin = spin
    assert node_module.main([]) == 0
    assert ros.node.destroyed
    assert ros.ended == 1
    assert said(ros.node)[0].header.frame_id == "hall"


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({}, "parameter model must name"),
        ({"model": "nowhere"}, "nowhere"),
        ({"model": "m", "silent_s": 0.0}, "silent_s must be more than 0 s"),
        ({"model": "m", "transform_tolerance": float("nan")}, "transform_tolerance must be more than 0 s"),
        ({"model": "m", "odom_frame": "map"}, "must name three frames"),
        ({"model": "m", "base_frame": ""}, "must name three frames"),
    ],
)
def test_parameters_that_cannot_be_used_are_named(ros, capsys, given, text):
    ros.given = given
    assert node_module.main([]) == 2
    assert text in capsys.readouterr().err
    assert ros.ended == 1


def test_models_in_map_units_are_refused(ros, world, monkeypatch, capsys):
    ros.given = {"model": "m"}
    in_units = replace(world[1], configuration={**world[1].configuration, "unit": "units"})
    monkeypatch.setattr(node_module, "load_model", lambda path: in_units)
    assert node_module.main([]) == 2
    told = capsys.readouterr().err
    assert told.startswith("error: m: its lengths are in map units, expected metres. ")
    assert all(how in told for how in ("--known-length", "--positions", "metres-per-unit.txt"))
    assert not ros.node.subscribed


def test_without_ros_the_node_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    assert node_module.main([]) == 2
    told = capsys.readouterr().err
    assert "install ROS 2 Jazzy or newer" in told
    assert "source /opt/ros/DISTRO/setup.bash" in told
    monkeypatch.setitem(sys.modules, "geometry_msgs.msg", None)
    with pytest.raises(MissingPackageError, match="comes with ROS 2 and not from pip"):
        message_class("geometry_msgs/msg/Pose")
