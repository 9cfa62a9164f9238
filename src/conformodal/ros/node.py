"""A ROS 2 node: images in, poses with covariances, candidates, regions and the path out.

``python -m conformodal.ros.node --ros-args -p model:=MODEL -r image:=/camera/image_raw
-r camera_info:=/camera/camera_info``

rclpy comes with ROS and is imported when the node starts.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from conformodal.core.errors import ConformodalError
from conformodal.core.extras import MissingPackageError
from conformodal.io.diagnosis.stale import RepeatWatch
from conformodal.io.streams import ros_messages
from conformodal.io.streams.frames import SourceError
from conformodal.pipeline.config import OdometryError
from conformodal.pipeline.estimates import Estimate
from conformodal.pipeline.estimator import odometry_of
from conformodal.pipeline.odometry import Odometry
from conformodal.pipeline.store import load_model

from .conversion import NAMESPACE, NANOSECONDS, TOPICS, Conversion, RosError

_DEPTH = 10  # of queues of messages
_JUMP_BACK_S = 1.0  # a clock that goes back by more was set anew: a recording is played again
BAD_INPUT = 2


@dataclass(frozen=True)
class Parameters:
    """Parameters of the node, by their names in ROS."""

    model: str = ""  # folder of a saved model
    world_frame: str = "map"  # of poses: the world of the training poses
    compressed: bool = False  # whether images are ``sensor_msgs/CompressedImage``
    # after so many seconds without an image the pose counts as lost; also the time between two such messages
    silent_s: float = 1.0


class PoseNode:
    """Subscribes and publishes with a node of rclpy; see :class:`Parameters`.

    Images are answered one after the other. ROS keeps a few that come meanwhile and drops the others.
    """

    def __init__(
        self,
        node: Any,
        odometry: Odometry,
        world_frame: str = "map",
        *,
        compressed: bool = False,
        silent_s: float = 1.0,
    ) -> None:
        ros_messages.rosbags_image()  # missing packages are told before the first image
        self.odometry, self._node, self._silent_s = odometry, node, silent_s
        self._log = node.get_logger()
        self._conversion = Conversion(world_frame, make_message)
        self._kind = ros_messages.COMPRESSED if compressed else ros_messages.RAW
        self._last_s: float | None = None
        self._repeats = RepeatWatch()
        self._answered_ns: int | None = None
        self._camera = self._refused = ""  # the camera as it was last published, and why it is not the model's
        odometry.reset()
        self._publishers = {
            name: node.create_publisher(message_class(kind), f"{NAMESPACE}/{name}", _DEPTH)
            for name, kind in TOPICS.items()
        }
        sensor = import_module("rclpy.qos").qos_profile_sensor_data
        images = node.create_subscription(message_class(self._kind), "image", self.on_image, sensor)
        self._topic = str(getattr(images, "topic_name", "image"))  # remapped: whether it is rectified
        node.create_subscription(message_class(ros_messages.INFO), "camera_info", self.on_camera_info, sensor)
        node.create_timer(silent_s, self.on_time)

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
        time_s = ros_messages.stamp_s(message)
        if not self._is_new(time_s):
            return
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
        stamp = message.header.stamp
        self._publish(estimate, stamp.sec * NANOSECONDS + stamp.nanosec)
        self._answered_ns = self._node.get_clock().now().nanoseconds

    def on_time(self) -> None:
        """Publish that the pose is lost when no image comes."""
        now_ns = self._node.get_clock().now().nanoseconds
        if self._answered_ns is not None and 0 <= now_ns - self._answered_ns < self._silent_s * NANOSECONDS:
            return
        self._publish(Estimate(now_ns / NANOSECONDS, problem=f"no image for {self._silent_s:g} s"), now_ns)

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
        self._last_s = time_s
        return True

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
        from rclpy.executors import ExternalShutdownException  # noqa: PLC0415
    rclpy.init(args=arguments)
    node = rclpy.create_node("conformodal")
    try:
        defaults = vars(Parameters())
        given = Parameters(**{name: node.declare_parameter(name, value).value for name, value in defaults.items()})
        if not given.model:
            raise RosError("parameter model must name the folder of a saved model: --ros-args -p model:=MODEL")
        if not given.silent_s > 0:
            raise RosError(f"parameter silent_s must be more than 0 s, got {given.silent_s}")
        odometry = odometry_of(load_model(given.model))
        PoseNode(node, odometry, given.world_frame, compressed=given.compressed, silent_s=given.silent_s)
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
