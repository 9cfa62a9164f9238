"""ROS 2 messages as plain dataclasses: names and order of the fields are ROS's own, and nothing of ROS is imported.

Numbers in a sequence without a fixed length are an :class:`array.array`, those in one of fixed length a NumPy array;
this is what ROS's own Python classes take. :func:`~.building.build` makes messages of another library of them.
"""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from .errors import RosError

NANOSECONDS = 1_000_000_000
_LAST_SECOND = 2**31 - 1


@dataclass(frozen=True)
class RosMessage:
    """A message; `TYPE` is the name that ROS knows it by."""

    TYPE: ClassVar[str]


@dataclass(frozen=True)
class Time(RosMessage):
    """Seconds and nanoseconds since the epoch."""

    TYPE: ClassVar[str] = "builtin_interfaces/msg/Time"
    sec: int = 0
    nanosec: int = 0

    @classmethod
    def of(cls, stamp_ns: int) -> Self:
        """A time in nanoseconds."""
        sec, nanosec = divmod(stamp_ns, NANOSECONDS)
        if not 0 <= sec <= _LAST_SECOND:
            raise RosError(f"a time of ROS must lie within 0 and {_LAST_SECOND} s, got {stamp_ns / NANOSECONDS:.9g} s")
        return cls(sec, nanosec)


def nanoseconds(timestamp_s: float) -> int:
    """A time in whole nanoseconds; the whole seconds are taken apart, so that no digit is lost."""
    sec = math.floor(timestamp_s)
    return sec * NANOSECONDS + round((timestamp_s - sec) * NANOSECONDS)


@dataclass(frozen=True)
class Duration(RosMessage):
    """Of a marker: 0 is for ever."""

    TYPE: ClassVar[str] = "builtin_interfaces/msg/Duration"
    sec: int = 0
    nanosec: int = 0


@dataclass(frozen=True)
class Header(RosMessage):
    """When, and in which frame."""

    TYPE: ClassVar[str] = "std_msgs/msg/Header"
    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass(frozen=True)
class Point(RosMessage):
    """Metres."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Point"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(frozen=True)
class Vector3(RosMessage):
    """Of a marker: its whole size in metres."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Vector3"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass(frozen=True)
class Quaternion(RosMessage):
    """In the order of ROS, the real part last."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Quaternion"
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass(frozen=True)
class Pose(RosMessage):
    """Turns and moves coordinates of the camera into those of the header's frame."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/Pose"
    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)

    @classmethod
    def of(cls, position_xyz: npt.NDArray[np.floating[Any]], quat_wxyz: npt.NDArray[np.floating[Any]]) -> Self:
        """Of a position (3,) and a unit quaternion (4,) with the real part first, as in the rest of the package."""
        w, x, y, z = (float(part) for part in quat_wxyz)
        return cls(Point(*(float(part) for part in position_xyz)), Quaternion(x, y, z, w))


@dataclass(frozen=True, eq=False)
class PoseWithCovariance(RosMessage):
    """`covariance` (36,) is 6x6 row by row: x, y, z, and rotations about the fixed axes x, y, z."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseWithCovariance"
    pose: Pose
    covariance: npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseWithCovarianceStamped(RosMessage):
    """A pose that says how far off it may be."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseWithCovarianceStamped"
    header: Header
    pose: PoseWithCovariance


@dataclass(frozen=True)
class PoseStamped(RosMessage):
    """A pose at a time."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseStamped"
    header: Header
    pose: Pose


@dataclass(frozen=True)
class PoseArray(RosMessage):
    """Poses of one time."""

    TYPE: ClassVar[str] = "geometry_msgs/msg/PoseArray"
    header: Header
    poses: list[Pose]


@dataclass(frozen=True)
class Path(RosMessage):
    """Poses of many times."""

    TYPE: ClassVar[str] = "nav_msgs/msg/Path"
    header: Header
    poses: list[PoseStamped]


@dataclass(frozen=True)
class MultiArrayDimension(RosMessage):
    """An axis of an array."""

    TYPE: ClassVar[str] = "std_msgs/msg/MultiArrayDimension"
    label: str
    size: int
    stride: int


@dataclass(frozen=True)
class MultiArrayLayout(RosMessage):
    """All axes of an array."""

    TYPE: ClassVar[str] = "std_msgs/msg/MultiArrayLayout"
    dim: list[MultiArrayDimension]
    data_offset: int = 0


@dataclass(frozen=True, eq=False)
class Float64MultiArray(RosMessage):
    """An array of numbers."""

    TYPE: ClassVar[str] = "std_msgs/msg/Float64MultiArray"
    layout: MultiArrayLayout
    data: array[float]


@dataclass(frozen=True)
class ColorRGBA(RosMessage):
    """From 0 to 1."""

    TYPE: ClassVar[str] = "std_msgs/msg/ColorRGBA"
    r: float = 0.0
    g: float = 0.0
    b: float = 0.0
    a: float = 0.0


@dataclass(frozen=True, eq=False)
class CompressedImage(RosMessage):
    """The bytes of a picture file."""

    TYPE: ClassVar[str] = "sensor_msgs/msg/CompressedImage"
    header: Header = field(default_factory=Header)
    format: str = ""
    data: array[int] = field(default_factory=lambda: array("B"))


@dataclass(frozen=True, eq=False)
class MeshFile(RosMessage):
    """Of a marker; empty here."""

    TYPE: ClassVar[str] = "visualization_msgs/msg/MeshFile"
    filename: str = ""
    data: array[int] = field(default_factory=lambda: array("B"))


@dataclass(frozen=True, eq=False)
class Marker(RosMessage):
    """Something to draw; here a box, or the order to remove all boxes."""

    TYPE: ClassVar[str] = "visualization_msgs/msg/Marker"
    CUBE: ClassVar[int] = 1
    ADD: ClassVar[int] = 0
    DELETEALL: ClassVar[int] = 3
    header: Header
    ns: str = ""
    id: int = 0
    type: int = CUBE
    action: int = ADD
    pose: Pose = field(default_factory=Pose)
    scale: Vector3 = field(default_factory=Vector3)
    color: ColorRGBA = field(default_factory=ColorRGBA)
    lifetime: Duration = field(default_factory=Duration)
    frame_locked: bool = False
    points: list[Point] = field(default_factory=list)
    colors: list[ColorRGBA] = field(default_factory=list)
    texture_resource: str = ""
    texture: CompressedImage = field(default_factory=CompressedImage)
    uv_coordinates: list[RosMessage] = field(default_factory=list)
    text: str = ""
    mesh_resource: str = ""
    mesh_file: MeshFile = field(default_factory=MeshFile)
    mesh_use_embedded_materials: bool = False


@dataclass(frozen=True)
class MarkerArray(RosMessage):
    """Things to draw."""

    TYPE: ClassVar[str] = "visualization_msgs/msg/MarkerArray"
    markers: list[Marker]


@dataclass(frozen=True)
class KeyValue(RosMessage):
    """A line of a status."""

    TYPE: ClassVar[str] = "diagnostic_msgs/msg/KeyValue"
    key: str
    value: str


@dataclass(frozen=True)
class DiagnosticStatus(RosMessage):
    """How something is: `level` is 0 where all is well, 1 for a warning, 2 for an error."""

    TYPE: ClassVar[str] = "diagnostic_msgs/msg/DiagnosticStatus"
    OK: ClassVar[int] = 0
    WARN: ClassVar[int] = 1
    ERROR: ClassVar[int] = 2
    level: int
    name: str
    message: str
    hardware_id: str
    values: list[KeyValue]


@dataclass(frozen=True)
class DiagnosticArray(RosMessage):
    """How several things are."""

    TYPE: ClassVar[str] = "diagnostic_msgs/msg/DiagnosticArray"
    header: Header
    status: list[DiagnosticStatus]
