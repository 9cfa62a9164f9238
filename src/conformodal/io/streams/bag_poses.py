"""Poses of the camera in a ROS recording, from a topic of poses or from transforms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.core.words import counted
from conformodal.geometry import Trajectory, matrix_from_quat_wxyz, poses_at, rigid_motions
from conformodal.geometry.metrics import MAX_GAP_S
from conformodal.io.pose_text import pose_faults
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
_NO_MOTION = (0, 0, 0, 1, 0, 0, 0)
_BY_HAND = "if these are the camera's poses, give them as a TUM file"


@dataclass
class _Edge:
    """Poses of a frame in its parent; of a static one, one."""

    parent: str
    rows: FloatArray  # (n, 8) time x y z qw qx qy qz

    def path(self) -> Trajectory:
        return Trajectory(self.rows[:, 0], self.rows[:, 1:4], self.rows[:, 4:])


_Tree = dict[str, _Edge]
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
    with bag_reader(bag.path) as reader:
        posed = [c for c in reader.connections if c.msgtype in (*_WITHIN, *_TRANSFORMS) and not _is_static(c)]
        kinds = {c.topic: c.msgtype for c in posed if c.msgcount}
        if topic not in kinds:
            named = ", ".join(sorted(kinds)) or "none"
            if "." in topic:  # as no name of a topic has
                raise SourceError(f"{topic}: no such file of poses; {bag.path} has poses on {named}")
            raise SourceError(f"{bag.path}: holds no poses on {topic}, which is no file either; there are {named}")
        camera = _camera_frame(reader, str(bag.topic))
        rows, fixed, n_bad = _Rows(), _Rows(), 0
        wanted = [c for c in reader.connections if c.topic == topic or _is_static(c)]
        try:
            for connection, received_ns, raw in reader.messages(connections=wanted):
                message = reader.deserialize(raw, connection.msgtype)
                into = rows if connection.topic == topic else fixed
                n_bad += _take(into, message, connection.msgtype, received_ns / 1e9 if bag.received else None)
        except Exception as exc:  # damaged bytes lead a decoder to any error
            raise SourceError(f"{place}: cannot be read: {exc}") from exc
    if n_bad:
        notes.append(Note("left out, pose cannot be used", f"{place}: {counted(n_bad, 'pose')}"))
    moving, static = _tree(rows, place, notes), _tree(fixed, place, notes)
    if not moving:
        raise SourceError(f"{place}: holds no pose that can be used")
    if kinds[topic] in _TRANSFORMS:
        return _along(moving, static, camera, place, notes, max_gap_s)
    if len(moving) > 1:
        raise SourceError(f"{place}: has poses of several frames ({', '.join(moving)}), expected one")
    ((frame, edge),) = moving.items()
    told = f"{place}: of {frame or 'a frame without a name, taken as the camera'} in {edge.parent or 'the world'}"
    path = _path(edge, told, notes)
    if frame in ("", camera):
        notes.append(Note("poses", told))
        return path
    (root, T_root_frame), (other, T_root_cam) = _to_root(static, frame), _to_root(static, camera)
    if root != other:
        lost = "" if static else f", and there is no /{_STATIC}"
        apart = f"and the images are of {camera!r}: no static transform connects them{lost}"
        raise SourceError(f"{told}, {apart}; {_BY_HAND}")
    notes.append(Note("poses", f"{told}, moved to {camera} by /{_STATIC}"))
    return Trajectory.from_poses_se3(path.timestamps_s, path.poses_se3 @ np.linalg.inv(T_root_frame) @ T_root_cam)


def _is_static(connection: Any) -> bool:
    return str(connection.topic).rpartition("/")[2] == _STATIC


def _camera_frame(reader: Any, topic: str) -> str:
    connections = [c for c in reader.connections if c.topic == topic]
    connection, _, raw = next(reader.messages(connections=connections))
    return _frame(reader.deserialize(raw, connection.msgtype).header.frame_id)


def _frame(name: str) -> str:
    return name.strip().lstrip("/")  # as early ROS 1 wrote it


def _take(into: _Rows, message: Any, kind: str, received_s: float | None) -> int:
    """Add the poses of a message; how many cannot be used."""
    if kind in _TRANSFORMS:
        return sum(_take(into, its, _TRANSFORM, received_s) for its in message.transforms)
    pose = message
    for name in _WITHIN[kind].split("."):
        pose = getattr(pose, name)
    at, turn = (pose.translation, pose.rotation) if kind == _TRANSFORM else (pose.position, pose.orientation)
    row = [received_s or stamp_s(message), at.x, at.y, at.z, turn.w, turn.x, turn.y, turn.z]
    values = np.array([row])
    if not np.isfinite(values).all() or pose_faults(values[:, 1:4], values[:, 4:]):
        return 1
    edge = _frame(getattr(message, "child_frame_id", "")), _frame(message.header.frame_id)
    into.setdefault(edge, []).append(row)
    return 0


def _tree(rows: _Rows, place: str, notes: list[Note]) -> _Tree:
    """Each frame with its parent: of several, the one with the most poses."""
    tree = _Tree()
    for (frame, parent), its in sorted(rows.items(), key=lambda item: -len(item[1])):
        if frame not in tree:
            tree[frame] = _Edge(parent, np.array(its))
            continue
        where = (
            f"{place}: {counted(len(its), 'pose')} of {frame or 'a frame without a name'} in {parent or 'the world'}"
        )
        notes.append(Note("left out, of another parent", f"{where}, not {tree[frame].parent or 'the world'}"))
    return tree


def _path(edge: _Edge, told: str, notes: list[Note]) -> Trajectory:
    """Poses of a frame; those that differ at the same time are left out."""
    rows = np.unique(edge.rows, axis=0)
    unclear = np.isin(rows[:, 0], rows[1:, 0][np.diff(rows[:, 0]) == 0])
    if unclear.any():
        where = (
            f"{told}: {unclear.sum()} of {counted(len(rows), 'pose')} have the time of another; do two nodes send them?"
        )
        if unclear.all():
            raise SourceError(where)
        notes.append(Note("left out, several poses at one time", where))
    return _Edge(edge.parent, rows[~unclear]).path()


def _to_root(static: _Tree, frame: str) -> tuple[str, FloatArray]:
    """The root above a frame in the tree of static transforms, and ``T_root_frame``."""
    pose, seen = np.eye(4), {frame}
    while (edge := static.get(frame)) is not None and edge.parent not in seen:
        pose, frame = edge.path()[-1:].poses_se3[0] @ pose, edge.parent
        seen.add(frame)
    return frame, pose


def _along(moving: _Tree, static: _Tree, camera: str, place: str, notes: list[Note], max_gap_s: float) -> Trajectory:
    """Poses of the camera's frame in the root of all transforms, at the times of the one that is sent most often."""
    chain, frame = list[str](), camera
    while frame not in chain and (frame in moving or frame in static):
        chain.append(frame)
        frame = (moving.get(frame) or static[frame]).parent
    if frame in chain:
        raise SourceError(f"{place}: leads from {' to '.join([*chain, frame])}, in a circle; {_BY_HAND}")
    driven = [its for its in chain if its in moving]
    if not driven:
        known = ", ".join(f"{its.parent} to {child}" for child, its in moving.items())
        raise SourceError(f"{place}: leads from {known}, and not to {camera!r}, which the images are of; {_BY_HAND}")
    paths = {its: _path(moving[its], f"{place}: of {its} in {moving[its].parent}", notes) for its in driven}
    leader = max(driven, key=lambda its: len(paths[its]))
    times = paths[leader].timestamps_s
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    there = np.ones(len(times), dtype=bool)
    for its in chain:
        if its in paths:
            rows, _ = poses_at(paths[its], times, max_gap_s)
            found = np.isfinite(rows).all(axis=1)
            rows[~found] = _NO_MOTION
            there &= found
            poses = rigid_motions(matrix_from_quat_wxyz(rows[:, 3:]), rows[:, :3]) @ poses
        else:
            poses = static[its].path()[-1:].poses_se3 @ poses
    if not there.any():
        raise SourceError(f"{place}: {' and '.join(driven)} are never within {max_gap_s:g} s of each other")
    if not there.all():
        where = (
            f"{place}: {(~there).sum()} of {counted(len(there), 'pose')}: {' and '.join(driven)} are not sent within"
        )
        notes.append(Note("left out, transforms are apart", f"{where} {max_gap_s:g} s (max_gap_s) of each other"))
    through = f", through {', '.join(reversed(chain[1:]))}" if chain[1:] else ""
    notes.append(Note("poses", f"{place}: of {camera} in {frame}{through}"))
    return Trajectory.from_poses_se3(times[there], poses[there])
