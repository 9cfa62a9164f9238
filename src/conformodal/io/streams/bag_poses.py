"""Poses of the camera in a ROS recording, from a topic of poses or from transforms."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted
from conformodal.geometry import Trajectory, matrix_from_quat_wxyz, poses_at, rigid_motions
from conformodal.geometry.metrics import MAX_GAP_S
from conformodal.io.pose_files import pose_faults
from conformodal.io.reading import Note

from .bag import BagStream, bag_reader
from .frames import SourceError
from .ros_messages import stamp_s

_TRANSFORM, _TRANSFORMS = "geometry_msgs/msg/TransformStamped", ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_WITHIN = {  # where a message has its pose
    "nav_msgs/msg/Odometry": "pose.pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "geometry_msgs/msg/PoseStamped": "pose",
    _TRANSFORM: "transform",
}
_STATIC = "tf_static"
_IDENTITY = (0, 0, 0, 1, 0, 0, 0)
_BY_HAND = "if these are the camera's poses, give them as a TUM file"


class _Edge(NamedTuple):
    """Poses of a frame in its parent: rows ``time x y z qw qx qy qz`` (n, 8)."""

    parent: str
    rows: FloatArray

    def trajectory(self) -> Trajectory:
        return Trajectory(self.rows[:, 0], self.rows[:, 1:4], self.rows[:, 4:])

    def last_pose(self) -> FloatArray:
        return np.asarray(self.trajectory()[-1:].poses_se3[0])


_Tree = dict[str, _Edge]  # by frame
_Rows = dict[tuple[str, str], list[list[float]]]  # of a frame in its parent


def read_bag_poses(bag: BagStream, topic: str, notes: list[Note], max_gap_s: float = MAX_GAP_S) -> Trajectory:
    """Poses ``T_world_cam`` of a recording, on the clock of its images.

    Parameters
    ----------
    bag
        The recording and the topic of its images, whose ``frame_id`` is the camera's frame.
    topic
        Of Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped; or of transforms, as ``/tf``, which
        lead from the camera's frame to the root of their tree. Poses of another frame are moved to the camera by
        ``/tf_static``; a message that does not name the frame is taken as the camera's.
    notes
        Receives which poses were used, and which were left out.
    max_gap_s
        Longest gap in seconds over which a transform is interpolated, where several lead to the camera.

    Raises
    ------
    SourceError
        If there are no poses on the topic, or nothing leads from their frame to the camera's.
    """
    place = f"{bag.path}: {topic}"
    moving_rows, static_rows, n_unusable = _Rows(), _Rows(), 0
    with bag_reader(bag.path) as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections if c.msgcount and not _is_static(c.topic)}
        kinds = {name: kind for name, kind in kinds.items() if kind in (*_WITHIN, *_TRANSFORMS)}
        if topic not in kinds:
            named = ", ".join(sorted(kinds)) or "none"
            if "." in topic:  # as no name of a topic has
                raise SourceError(f"{topic}: no such file of poses; {bag.path} has poses on {named}")
            raise SourceError(f"{bag.path}: holds no poses on {topic}, which is no file either; there are {named}")
        wanted = [c for c in reader.connections if c.topic == topic or _is_static(c.topic)]
        images = [c for c in reader.connections if c.topic == bag.topic]
        try:
            connection, _, raw = next(reader.messages(connections=images))
            camera = _frame(reader.deserialize(raw, connection.msgtype).header.frame_id)
            for connection, received_ns, raw in reader.messages(connections=wanted):
                message, received_s = reader.deserialize(raw, connection.msgtype), received_ns / 1e9
                is_transforms = connection.msgtype in _TRANSFORMS
                for each in message.transforms if is_transforms else [message]:
                    time_s = received_s if bag.received else stamp_s(each)
                    row = [time_s, *_pose_of(each, _TRANSFORM if is_transforms else connection.msgtype)]
                    if not np.isfinite(row).all() or pose_faults(np.array([row[1:4]]), np.array([row[4:]])):
                        n_unusable += 1
                        continue
                    frames = _frame(getattr(each, "child_frame_id", "")), _frame(each.header.frame_id)
                    (static_rows if connection.topic != topic else moving_rows).setdefault(frames, []).append(row)
        except Exception as exc:  # damaged bytes lead a decoder to any error
            raise SourceError(f"{place}: cannot be read: {exc}") from exc
    if n_unusable:
        notes.append(Note("left out, pose cannot be used", f"{place}: {counted(n_unusable, 'pose')}"))
    moving, static = _tree(moving_rows, place), _tree(static_rows, f"{bag.path}: /{_STATIC}", static=True)
    if not moving:
        raise SourceError(f"{place}: holds no pose that can be used")
    if kinds[topic] in _TRANSFORMS:
        return _along_transforms(moving, static, camera, place, notes, max_gap_s)
    if len(moving) > 1:
        raise SourceError(f"{place}: has poses of several frames ({', '.join(moving)}), expected one")
    ((frame, edge),) = moving.items()
    told = f"{place}: of {frame or 'a frame without a name, taken as the camera'} in {edge.parent or 'the world'}"
    path = edge.trajectory()
    if frame in ("", camera):
        notes.append(Note("poses", told))
        return path
    (root, T_root_frame), (other, T_root_cam) = _to_root(static, frame), _to_root(static, camera)
    if root != other:
        missing = "" if static else f", and there is no /{_STATIC}"
        apart = f"and the images are of {camera!r}: no static transform connects them{missing}"
        raise SourceError(f"{told}, {apart}; {_BY_HAND}")
    notes.append(Note("poses", f"{told}, moved to {camera} by /{_STATIC}"))
    return Trajectory.from_poses_se3(path.timestamps_s, path.poses_se3 @ np.linalg.inv(T_root_frame) @ T_root_cam)


def _is_static(topic: str) -> bool:
    return topic.rpartition("/")[2] == _STATIC


def _frame(name: str) -> str:
    return name.strip().lstrip("/")  # as early ROS 1 wrote it


def _pose_of(message: Any, kind: str) -> list[float]:
    """Position and quaternion, real part first, of a message."""
    for name in _WITHIN[kind].split("."):
        message = getattr(message, name)
    of_transform = kind == _TRANSFORM
    at, turn = (message.translation, message.rotation) if of_transform else (message.position, message.orientation)
    return [at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z]


def _tree(rows: _Rows, place: str, *, static: bool = False) -> _Tree:
    """Each frame with its parent, of which there is one, and one pose per time; static ones may be sent again."""
    tree = _Tree()
    for (frame, parent), poses in rows.items():
        if frame in tree:
            parents = f"{tree[frame].parent or 'the world'} and in {parent or 'the world'}"
            raise SourceError(f"{place}: has poses of {frame or 'a frame without a name'} in {parents}; {_BY_HAND}")
        tree[frame] = _Edge(parent, np.unique(poses, axis=0))
        twice = int((np.diff(tree[frame].rows[:, 0]) == 0).sum())
        if twice and not static:
            of = f"{counted(twice, 'pose')} of {frame or 'a frame without a name'}"
            raise SourceError(f"{place}: {of} have the time of another; do two nodes send them?")
    return tree


def _to_root(static: _Tree, frame: str) -> tuple[str, FloatArray]:
    """The root above a frame in the tree of static transforms, and ``T_root_frame``."""
    pose, passed = np.eye(4), {frame}
    while (edge := static.get(frame)) is not None and edge.parent not in passed:
        pose, frame = edge.last_pose() @ pose, edge.parent
        passed.add(frame)
    return frame, pose


def _along_transforms(
    moving: _Tree, static: _Tree, camera: str, place: str, notes: list[Note], max_gap_s: float
) -> Trajectory:
    """Poses of the camera's frame in the root of all transforms, at the times of the one that is sent most often."""
    chain, root = list[str](), camera
    while root not in chain and (root in moving or root in static):
        chain.append(root)
        root = (moving.get(root) or static[root]).parent
    if root in chain:
        raise SourceError(f"{place}: leads from {' to '.join([*chain, root])}, in a circle; {_BY_HAND}")
    paths = {frame: moving[frame].trajectory() for frame in chain if frame in moving}
    if not paths:
        ends = ", ".join(f"{edge.parent} to {child}" for child, edge in moving.items())
        raise SourceError(f"{place}: leads from {ends}, and not to {camera!r}, which the images are of; {_BY_HAND}")
    times = max(paths.values(), key=len).timestamps_s
    poses, complete = np.tile(np.eye(4), (len(times), 1, 1)), np.ones(len(times), dtype=bool)
    for frame in chain:
        if frame not in paths:
            poses = static[frame].last_pose() @ poses
            continue
        rows, _ = poses_at(paths[frame], times, max_gap_s)
        missing = ~np.isfinite(rows).all(axis=1)
        rows[missing], complete = _IDENTITY, complete & ~missing
        poses = rigid_motions(matrix_from_quat_wxyz(rows[:, 3:]), rows[:, :3]) @ poses
    if not complete.any():
        raise SourceError(f"{place}: {' and '.join(paths)} are never within {max_gap_s:g} s of each other")
    if not complete.all():
        of = f"{(~complete).sum()} of {counted(len(times), 'pose')}: {' and '.join(paths)} are not sent within"
        notes.append(Note("left out, transforms are apart", f"{place}: {of} {max_gap_s:g} s (max_gap_s) of each other"))
    through = f", through {', '.join(reversed(chain[1:]))}" if chain[1:] else ""
    notes.append(Note("poses", f"{place}: of {camera} in {root}{through}"))
    return Trajectory.from_poses_se3(times[complete], poses[complete])
