"""Poses of the camera in a ROS recording, from a topic of poses or from transforms."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted
from conformodal.geometry import Trajectory, poses_at
from conformodal.geometry.metrics import MAX_GAP_S
from conformodal.geometry.poses import matrices_of
from conformodal.io.pose_files import pose_faults
from conformodal.io.reading import Note

from .bag import BagStream, bag_reader
from .frames import SourceError
from .ros_messages import stamp_s

_TRANSFORMS, _PATH = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"), "nav_msgs/msg/Path"
_LISTS = dict.fromkeys(_TRANSFORMS, "transforms") | {_PATH: "poses"}  # where a message has several
_KINDS = ("Odometry", "PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "TFMessage", "tfMessage", "Path")
_STATIC = "tf_static"
_BY_HAND = "if these are the camera's poses, give them as a TUM file"

# Of each frame (child) its parent, and rows ``time x y z qw qx qy qz`` of its poses in it.
_Tree = dict[str, tuple[str, list[list[float]]]]


class _Edge(NamedTuple):
    """Poses of a frame in its parent, and its own in the root of the static tree."""

    frame: str
    parent: str
    path: Trajectory
    T_root_frame: FloatArray


def read_bag_poses(bag: BagStream, topic: str, notes: list[Note], max_gap_s: float = MAX_GAP_S) -> Trajectory:
    """Poses ``T_world_cam`` of a recording, on the clock of its images, whose ``frame_id`` is the camera's frame.

    The topic is one of Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped; of Path, whose last
    message is read, as SLAM corrects what it sent before; or of transforms, as ``/tf``, which lead from the camera's
    frame to the root of their tree. Poses of another frame are moved to the camera by ``/tf_static``; those of a
    message that does not name the frame are taken as the camera's. `notes` receives which poses were used; `max_gap_s`
    is the longest gap over which a transform is interpolated.
    """
    place = f"{bag.path}: {topic}"
    moving, static, n_unusable = _Tree(), _Tree(), 0
    with bag_reader(bag.path) as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections if c.msgcount and not _is_static(c.topic)}
        kinds = {name: kind for name, kind in kinds.items() if kind.rpartition("/")[2] in _KINDS}
        if topic not in kinds:
            named = ", ".join(sorted(kinds)) or "none"
            raise SourceError(f"{bag.path}: holds no poses on {topic}, which is no file either; there are {named}")
        try:
            images = [c for c in reader.connections if c.topic == bag.topic]
            connection, _, raw = next(reader.messages(connections=images))
            camera = _frame(reader.deserialize(raw, connection.msgtype).header.frame_id)
            wanted = [c for c in reader.connections if c.topic == topic or _is_static(c.topic)]
            n_paths = sum(c.msgcount for c in wanted if c.msgtype == _PATH)
            for connection, received_ns, raw in reader.messages(connections=wanted):
                kind, sent = connection.msgtype, list[Any]()
                n_paths -= kind == _PATH
                if kind != _PATH or not n_paths:  # the last path corrects those before it
                    message = reader.deserialize(raw, kind)
                    sent = getattr(message, _LISTS[kind]) if kind in _LISTS else [message]
                for each in sent:
                    time_s = received_ns / 1e9 if bag.received else stamp_s(each)
                    row = [time_s, *_pose_of(each)]
                    if not np.isfinite(row).all() or pose_faults(np.array([row[1:4]]), np.array([row[4:]])):
                        n_unusable += 1
                        continue
                    header = message.header if kind == _PATH else each.header
                    frame, parent = _frame(getattr(each, "child_frame_id", "")) or camera, _frame(header.frame_id)
                    tree = moving if connection.topic == topic else static
                    if tree.setdefault(frame, (parent, []))[0] != parent:
                        raise ValueError(f"has poses of {frame} in {tree[frame][0]} and in {parent}; {_BY_HAND}")
                    tree[frame][1].append(row)
        except Exception as exc:  # damaged bytes lead a decoder to any error
            raise SourceError(f"{place}: cannot be read: {exc}") from exc
    if kinds[topic].endswith(("PoseStamped", "PoseWithCovarianceStamped", "Path")):
        notes.append(Note("poses", f"{place}: name no frame, and are taken as those of the camera"))
    if n_unusable:
        notes.append(Note("left out, pose cannot be used", f"{place}: {counted(n_unusable, 'pose')}"))
    if not moving or (len(moving) > 1 and kinds[topic] not in _TRANSFORMS):
        raise SourceError(f"{place}: has poses of {', '.join(moving) or 'no frame'}, expected those of one frame")
    return _along(moving, static, camera, place, notes, max_gap_s)


def _along(moving: _Tree, static: _Tree, camera: str, place: str, notes: list[Note], max_gap_s: float) -> Trajectory:
    """Poses of the camera in the root of all transforms, at the times of the one that is sent most often."""
    edges = dict[str, _Edge]()  # by the root of the frame in the static tree
    for frame, (parent, rows) in moving.items():
        root, T_root_frame = _to_root(static, frame)
        if root in edges:
            both = f"{frame} and {edges[root].frame}"
            raise SourceError(f"{place}: moves {both}, which are fixed to each other; {_BY_HAND}")
        edges[root] = _Edge(frame, parent, _path(np.unique(rows, axis=0), place, frame), T_root_frame)
    root, T_root_cam = _to_root(static, camera)
    chain = []
    while root in edges:
        chain.append(edges.pop(root))
        root, _ = _to_root(static, chain[-1].parent)
    if not chain:
        ends = ", ".join(f"{parent} to {frame}" for frame, (parent, _) in moving.items())
        apart = "" if static else f"; there is no /{_STATIC}"
        where = f"{place}: leads from {ends}, and not to {camera!r}, which the images are of{apart}"
        raise SourceError(f"{where}; {_BY_HAND}")
    times = max((edge.path for edge in chain), key=len).timestamps_s
    poses = np.tile(T_root_cam, (len(times), 1, 1))
    for edge in chain:
        _, T_next_parent = _to_root(static, edge.parent)
        T_parent_frame = matrices_of(poses_at(edge.path, times, max_gap_s).rows)
        poses = T_next_parent @ T_parent_frame @ np.linalg.inv(edge.T_root_frame) @ poses
    complete = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    if not complete.any():
        raise SourceError(f"{place}: its transforms are never within {max_gap_s:g} s of each other")
    if not complete.all():
        lost = f"{(~complete).sum()} of {counted(len(times), 'pose')}"
        where = f"{place}: {lost}, by more than {max_gap_s:g} s (--max-gap)"
        notes.append(Note("left out, transforms are apart", where))
    through = "".join(f", through {edge.frame}" for edge in reversed(chain) if edge.frame != camera)
    notes.append(Note("poses", f"{place}: of {camera or 'the camera'} in {root or 'the world'}{through}"))
    return Trajectory.from_poses_se3(times[complete], poses[complete])


def _is_static(topic: str) -> bool:
    return topic.rpartition("/")[2] == _STATIC


def _frame(name: str) -> str:
    return name.strip().lstrip("/")  # as early ROS 1 wrote it


def _pose_of(message: Any) -> list[float]:
    """Position and quaternion, real part first, of a message."""
    if hasattr(message, "transform"):
        at, turn = message.transform.translation, message.transform.rotation
    else:
        pose = getattr(message.pose, "pose", message.pose)  # with a covariance, it is in a pose of its own
        at, turn = pose.position, pose.orientation
    return [at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z]


def _path(rows: FloatArray, place: str, frame: str) -> Trajectory:
    if (np.diff(rows[:, 0]) == 0).any():
        raise SourceError(f"{place}: has two poses of {frame} for one time; do two nodes send them?")
    return Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:])


def _to_root(static: _Tree, frame: str) -> tuple[str, FloatArray]:
    """The root above a frame in the tree of static transforms, and ``T_root_frame``."""
    pose, passed = np.eye(4), {frame}
    while frame in static and static[frame][0] not in passed:
        frame, rows = static[frame]
        pose = matrices_of(np.array(rows[-1:])[:, 1:])[0] @ pose
        passed.add(frame)
    return frame, pose
