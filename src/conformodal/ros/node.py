"""A ROS 2 node: images in, poses with covariances, candidates, regions, the path and odometry's place in the map out.

``python -m conformodal.ros.node --ros-args -p model:=MODEL -r image:=/camera/image_raw
-r camera_info:=/camera/camera_info``

rclpy comes with ROS and is imported when the node starts.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from typing import Any

from conformodal.core.arrays import FloatArray
from conformodal.core.errors import ConformodalError
from conformodal.core.extras import MissingPackageError
from conformodal.io.diagnosis.stale import RepeatWatch
from conformodal.io.frame_table import METRES_PER_UNIT
from conformodal.io.streams import ros_messages
from conformodal.io.streams.frames import SourceError
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.estimator import VisualOdometry, odometry_of
from conformodal.pipeline.model import PoseModel
from conformodal.pipeline.odometry import Odometry
from conformodal.pipeline.store import load_model

from .conversion import LIVE, NAMESPACE, NANOSECONDS, TOPICS, Conversion, RosError
from .map_to_odom import MapToOdom
from .parameters import Parameters
from .transforms import hint_of, matrix_of

_DEPTH = 10  # of queues of messages
_JUMP_BACK_S = 1.0  # a clock that goes back by more was set anew: a recording is played again
_STATUS_S = 1.0  # between messages for /diagnostics
_WAIT_S = 0.1  # for a transform of the time of an image; odometry may come later than the image
_HINT_S = 0.1  # between an initial pose, which has no image, and the next image
BAD_INPUT = 2


class TransformTree:
    """The transforms of ``/tf`` and ``/tf_static``, through tf2_ros."""

    def __init__(self, node: Any) -> None:
        with _require_ros():
            tf2, time, duration = (import_module(name) for name in ("tf2_ros", "rclpy.time", "rclpy.duration"))
        self._time, self._duration, self._unknown = time.Time, duration.Duration, tf2.TransformException
        self._buffer = tf2.Buffer()
        self._listener = tf2.TransformListener(self._buffer, node)
        self.send = tf2.TransformBroadcaster(node).sendTransform

    def look_up(self, target: str, source: str, stamp_ns: int) -> FloatArray:
        """The transform (4, 4) from a frame to another at a time, or a RosError that says what is missing.

        A transform that is late is waited for, one between frames that were never connected is not.
        """
        if not source:
            raise RosError("the headers of the images name no frame_id")
        frames = target.lstrip("/"), source.lstrip("/")  # as in ROS 1
        try:
            wait_s = _WAIT_S if self._buffer.can_transform(*frames, self._time()) else 0.0
            when, wait = self._time(nanoseconds=stamp_ns), self._duration(seconds=wait_s)
            return matrix_of(self._buffer.lookup_transform(*frames, when, wait).transform)
        except self._unknown as exc:
            raise RosError(f"no transform from {source} to {target}: {exc}") from exc

    def clear(self) -> None:
        """Forget the transforms that change: time was set back."""
        self._buffer.clear()


class PoseNode:
    """Subscribes and publishes with a node of rclpy; see :class:`Parameters`.

    Images are answered one after the other. ROS keeps a few that come meanwhile and drops the others.
    """

    def __init__(self, node: Any, odometry: Odometry, given: Parameters | None = None) -> None:
        ros_messages.rosbags_image()  # missing packages are told before the first image
        self.given = given = given or Parameters()
        self.odometry, self._node = odometry, node
        self._log = node.get_logger()
        self._conversion = Conversion(given.world_frame, make_message)
        self._tree = TransformTree(node)
        self._map_to_odom = MapToOdom(self._conversion, self._tree.look_up, given)
        self._kind = ros_messages.COMPRESSED if given.compressed else ros_messages.RAW
        self._last_s: float | None = None
        self._repeats = RepeatWatch()
        self._answered_ns: int | None = None
        self._camera = self._refused = ""  # the camera as it was last published, and why it is not the model's
        self._initial_pose: Any = None  # that the next image uses
        odometry.reset()
        self._publishers = {
            name: node.create_publisher(message_class(kind), f"{NAMESPACE}/{name}", _DEPTH)
            for name, kind in (TOPICS | LIVE).items()
        }
        self._diagnostics = node.create_publisher(message_class(TOPICS["status"]), "/diagnostics", _DEPTH)
        sensor = import_module("rclpy.qos").qos_profile_sensor_data
        images = node.create_subscription(message_class(self._kind), "image", self.on_image, sensor)
        self._topic = str(getattr(images, "topic_name", "image"))  # remapped: whether it is rectified
        node.create_subscription(message_class(ros_messages.INFO), "camera_info", self.on_camera_info, sensor)
        node.create_subscription(message_class(TOPICS["pose"]), "initialpose", self.on_initial_pose, _DEPTH)
        # no later than half the tolerance after the last one, wherever the answer lies between two calls of the timer
        self._refresh_ns = round(given.transform_tolerance * NANOSECONDS / 4)
        node.create_timer(given.silent_s, self.on_time)
        node.create_timer(self._refresh_ns / NANOSECONDS, self.on_refresh)
        node.create_timer(_STATUS_S, self.on_status)

    def on_camera_info(self, message: Any) -> None:
        """Compare the camera with the model's; images of another one are answered as lost."""
        camera = ros_messages.key_of_info(message)
        if camera == self._camera:
            return
        self._camera, self._refused = camera, ""
        try:
            self.odometry.model.check_camera(ros_messages.camera_of_info(message, "camera_info", self._topic))
        except (SourceError, OdometryError) as exc:
            self._refused = str(exc)
            self._log.error(f"images are not answered: {exc}")

    def on_image(self, message: Any) -> None:
        """Answer an image, with messages that have its time."""
        time_s, stamp = ros_messages.stamp_s(message), message.header.stamp
        if not self._is_new(time_s):
            return
        stamp_ns = stamp.sec * NANOSECONDS + stamp.nanosec
        self._use_initial_pose(time_s, stamp_ns, message.header.frame_id)
        if self._refused:
            estimate = Estimate(time_s, problem=self._refused)
        else:
            try:
                image, problem = ros_messages.image_of(message, self._kind), ""
            except ValueError as exc:
                image, problem = None, str(exc)
            if image is not None and (problem := self._repeats.check(image, time_s, f"image of {time_s:.9f} s")):
                image = None
            estimate = self.odometry.step(image, time_s)
            estimate = replace(estimate, problem=problem) if problem else estimate
        self._publish(estimate, stamp_ns)
        base_pose = self._map_to_odom.update(estimate, stamp_ns, message.header.frame_id)
        if base_pose is not None:
            self._publishers["base_pose"].publish(base_pose)
        self._answered_ns = self._now_ns()
        self._send_transform()

    def on_initial_pose(self, message: Any) -> None:
        """Take where an operator says that the robot is; the next image uses it."""
        frame, world = message.header.frame_id.lstrip("/"), self.given.world_frame.lstrip("/")
        if frame != world:
            self._log.warning(f"initial pose is not used: it is in the frame {frame!r}, expected {world!r}")
        elif not isinstance(self.odometry, VisualOdometry):
            self._log.warning("initial pose is not used: a model of the paper's method takes none")
        else:
            self._initial_pose = message.pose

    def on_time(self) -> None:
        """Publish that the pose is lost when no image comes."""
        now_ns, silent_s = self._now_ns(), self.given.silent_s
        if self._answered_ns is not None and 0 <= now_ns - self._answered_ns < silent_s * NANOSECONDS:
            return
        problem = f"no image for {silent_s:g} s"
        self._map_to_odom.miss(problem)
        self._publish(Estimate(now_ns / NANOSECONDS, problem=problem), now_ns)

    def on_refresh(self) -> None:
        """Send the last transform again when no image comes, before it is no longer valid."""
        if self._elapsed_ns() >= self._refresh_ns:
            self._send_transform()

    def on_status(self) -> None:
        """Say on ``/diagnostics`` whether the pose is reliable."""
        self._diagnostics.publish(self._map_to_odom.status(self._now_ns(), self._elapsed_ns()))

    def _is_new(self, time_s: float) -> bool:
        """Whether a time follows the last one; if it lies far before it, a new recording has begun."""
        if self._last_s is not None and time_s <= self._last_s:
            if time_s > self._last_s - _JUMP_BACK_S:
                self._log.warning(f"an image of {time_s:.9f} s came after that of {self._last_s:.9f} s and is left out")
                return False
            self._log.info("time was set back: the path begins anew")
            self.odometry.reset()
            self._repeats = RepeatWatch()
            self._conversion.reset()
            self._map_to_odom.reset()
            self._tree.clear()
        self._last_s = time_s
        return True

    def _use_initial_pose(self, time_s: float, stamp_ns: int, camera_frame: str) -> None:
        if time_s == 0:  # there is no time before, at which the path could begin: the next image takes it
            return
        pose, self._initial_pose = self._initial_pose, None
        if pose is None or not isinstance(self.odometry, VisualOdometry):
            return
        try:
            hint = hint_of(pose, self._tree.look_up(self.given.base_frame, camera_frame, stamp_ns))
        except ConformodalError as exc:
            self._log.warning(f"initial pose is not used: {exc}")
            return
        self.odometry.start_near(hint, time_s - min(_HINT_S, time_s / 2))  # ROS has no times before 0
        self._conversion.reset(time_s)
        x, y, z = hint.positions_xyz[0]
        self._log.info(f"initial pose: the path begins anew with the camera near {x:.2f} {y:.2f} {z:.2f} m")

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _elapsed_ns(self) -> int:
        """Since the last image was answered."""
        return 0 if self._answered_ns is None else max(self._now_ns() - self._answered_ns, 0)

    def _send_transform(self) -> None:
        transform = self._map_to_odom.transform(self._elapsed_ns())
        if transform is not None:
            self._tree.send(transform)

    def _publish(self, estimate: Estimate, stamp_ns: int) -> None:
        for name, message in self._conversion.messages(estimate, stamp_ns).items():
            self._publishers[name].publish(message)


def message_class(kind: str) -> Any:
    """ROS's own class of a type, such as ``geometry_msgs/msg/Pose``."""
    package, _, name = kind.split("/")
    with _require_ros():
        return getattr(import_module(f"{package}.msg"), name)


def make_message(kind: str, **fields: Any) -> Any:
    """A message in ROS's own class."""
    if kind == "diagnostic_msgs/msg/DiagnosticStatus":
        fields["level"] = bytes([fields["level"]])  # rclpy has a byte as bytes
    return message_class(kind)(**fields)


@contextmanager
def _require_ros() -> Iterator[None]:
    """Around imports of what comes with ROS and not from pip."""
    try:
        yield
    except ModuleNotFoundError as exc:
        raise MissingPackageError(
            f"the node needs {exc.name}, which comes with ROS 2 and not from pip: install ROS 2 Jazzy or newer, "
            "source /opt/ros/DISTRO/setup.bash, and run the node with ROS's Python (a virtual environment needs "
            "--system-site-packages)"
        ) from exc


def main(arguments: list[str] | None = None) -> int:
    """Run the node until ROS or a signal ends it; returns an exit code."""
    try:
        _run(arguments)
    except ConformodalError as exc:
        print(f"error: {exc}", file=sys.stderr)
        return BAD_INPUT
    return 0


def _run(arguments: list[str] | None) -> None:
    with _require_ros():
        import rclpy  # noqa: PLC0415 - comes with ROS
        from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor  # noqa: PLC0415
    rclpy.init(args=arguments)
    node = rclpy.create_node("conformodal")
    try:
        defaults = vars(Parameters())
        given = Parameters(**{name: node.declare_parameter(name, value).value for name, value in defaults.items()})
        if not given.model:
            raise RosError("parameter model must name the folder of a saved model: --ros-args -p model:=MODEL")
        model = load_model(given.model)
        _check_metres(given.model, model)
        PoseNode(node, odometry_of(model), given)
        rclpy.spin(node, MultiThreadedExecutor(num_threads=2))  # transforms come while an image is answered
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _check_metres(path: str, model: PoseModel) -> None:
    """Refuse a model without a metric scale: ROS takes lengths for metres, and odometry has them."""
    if model.configuration["unit"] != "m":
        how = f"--known-length or --positions (conformodal map), or {METRES_PER_UNIT} in the folder of its recording"
        raise RosError(f"{path}: its lengths are in map units, expected metres. Give {how}, and train again")


if __name__ == "__main__":
    sys.exit(main())
