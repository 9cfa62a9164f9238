"""ROS 2 messages by the names of their types, in the classes of rosbags; the node makes the same in those of ROS."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.extras import require_extra

from .conventions import RosError

# Called with the name of a type and some of its fields. Sequences of numbers are given as an array.array, those of
# fixed length as a NumPy array.
MakeMessage = Callable[..., Any]

NANOSECONDS = 1_000_000_000
_LAST_SECOND = 2**31 - 1


def rosbags_factory() -> MakeMessage:
    """Makes messages in the classes of rosbags; fields that are not given are zero or empty."""
    with require_extra("ros", "ROS messages"):
        from rosbags.interfaces import Nodetype  # noqa: PLC0415 - an extra
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    store: Any = get_typestore(Stores.ROS2_HUMBLE)

    def default(node: Any, what: Any) -> Any:
        if node == Nodetype.NAME:
            return make(what)
        if node == Nodetype.BASE:
            return {"string": "", "bool": False}.get(what[0], 0)
        (of, name), _ = what
        return [] if of == Nodetype.NAME else np.empty(0, dtype=name[0])

    def make(kind: str, **given: Any) -> Any:
        missing = {name: default(*of) for name, of in store.fielddefs[kind][1] if name not in given}
        arrays = {name: np.asarray(value) for name, value in given.items() if isinstance(value, array)}
        return store.types[kind](**{**missing, **given, **arrays})

    return make


def nanoseconds(timestamp_s: float) -> int:
    """A time in whole nanoseconds; whole seconds are converted apart, so that no digit is lost."""
    sec = math.floor(timestamp_s)
    return sec * NANOSECONDS + round((timestamp_s - sec) * NANOSECONDS)


def make_header(make: MakeMessage, stamp_ns: int, frame: str) -> Any:
    """A header with a time in nanoseconds, which ROS can hold from 0 to 2^31 - 1 s."""
    sec, nanosec = divmod(stamp_ns, NANOSECONDS)
    if not 0 <= sec <= _LAST_SECOND:
        raise RosError(f"a time of ROS must lie within 0 and {_LAST_SECOND} s, got {stamp_ns / NANOSECONDS:.9g} s")
    stamp = make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def make_pose(
    make: MakeMessage, position_xyz: npt.ArrayLike = (0.0, 0.0, 0.0), quat_wxyz: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0)
) -> Any:
    """A pose, by default the identity; ROS has the real part of a quaternion last."""
    (x, y, z), (qw, qx, qy, qz) = (np.asarray(v, dtype=np.float64).tolist() for v in (position_xyz, quat_wxyz))
    position = make("geometry_msgs/msg/Point", x=x, y=y, z=z)
    return make(
        "geometry_msgs/msg/Pose",
        position=position,
        orientation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )
