"""From an estimate to ROS 2 messages: poses with covariances, candidates with weights, regions as boxes, the path.

Nothing of ROS is imported. Where a frame is lost (no image, or one that shows no place that is known), no pose is
passed on: the message holds the identity with a very large covariance, and candidates and boxes are none.
"""

from __future__ import annotations

from array import array
from collections import deque

import numpy as np

from conformodal.poses import Trajectory
from conformodal.running.estimates import Estimate

from . import messages as ros
from .boxes import region_boxes, region_message
from .conventions import Conventions, is_lost
from .covariance import pose_covariance, weights_of


def _pose_message(estimate: Estimate, header: ros.Header, how: Conventions) -> ros.PoseWithCovarianceStamped:
    """The chosen pose and its covariance; the identity and a very large one where the frame is lost."""
    if is_lost(estimate) or estimate.pose is None:
        pose, covariance = ros.Pose(), np.eye(6) * how.lost_variance
    else:
        pose, covariance = _poses(estimate.pose)[0], pose_covariance(estimate, how.covariance)
    return ros.PoseWithCovarianceStamped(header, ros.PoseWithCovariance(pose, covariance.ravel()))


def _candidate_messages(estimate: Estimate, header: ros.Header) -> tuple[ros.PoseArray, ros.Float64MultiArray]:
    """Candidate poses, most probable first, and their weights in the same order; none where the frame is lost."""
    found = None if is_lost(estimate) else estimate.candidates
    poses: list[ros.Pose] = []
    weights = np.empty(0)
    if found is not None:
        weights = weights_of(found)
        pairs = zip(found.positions_xyz, found.orientations_quat_wxyz, strict=True)
        poses = [ros.Pose.of(position, quat) for position, quat in pairs]
    n = len(poses)
    layout = ros.MultiArrayLayout([ros.MultiArrayDimension("candidate", n, n)])
    return ros.PoseArray(header, poses), ros.Float64MultiArray(layout, array("d", weights.tolist()))


def _status_message(estimate: Estimate, header: ros.Header, n_boxes: int, n_shown: int) -> ros.DiagnosticArray:
    """What the pose rests on: an error where the frame is lost, a warning where motion could not be used."""
    status = ros.DiagnosticStatus
    level = status.ERROR if is_lost(estimate) else status.OK if estimate.reliable else status.WARN
    motion = estimate.relative_motion
    said = {
        "evidence": "none" if estimate.evidence is None else estimate.evidence.name.lower(),
        "known_p": "" if estimate.known_p is None else f"{estimate.known_p:.6g}",
        "motion": "none" if motion is None else str(motion.status),
        "boxes": str(n_boxes),
        "boxes_shown": str(n_shown),
    }
    values = [ros.KeyValue(key, value) for key, value in said.items()]
    message = (estimate.problem or "reliable").encode("utf-8", "backslashreplace").decode()
    return ros.DiagnosticArray(header, [status(level, "conformodal: pose", message, "", values)])


class Conversion:
    """Makes messages of estimate after estimate, and keeps the path.

    Parameters
    ----------
    how
        Names and limits.
    """

    def __init__(self, how: Conventions | None = None) -> None:
        self.how = how or Conventions()
        self.reset()

    def reset(self) -> None:
        """Forget the path: another recording begins."""
        self._path: deque[tuple[float, ros.Pose]] = deque(maxlen=self.how.longest_path)
        self._lost: set[float] = set()
        self._n_answered = 0

    def messages(self, estimate: Estimate, stamp_ns: int | None = None) -> dict[str, ros.RosMessage]:
        """All messages about a frame by the names of their topics, see :data:`TOPICS`; the path now and then.

        Parameters
        ----------
        estimate
            Of the frame.
        stamp_ns
            Its time in nanoseconds; by default the estimate's.

        Raises
        ------
        RosError
            If ROS has no such time.
        """
        stamp_ns = ros.nanoseconds(estimate.timestamp_s) if stamp_ns is None else stamp_ns
        header = self._header(stamp_ns)
        boxes, shares, total = region_boxes(estimate, self.how)
        poses, weights = _candidate_messages(estimate, header)
        found: dict[str, ros.RosMessage] = {
            "pose": _pose_message(estimate, header, self.how),
            "candidates": poses,
            "candidate_weights": weights,
            "region": region_message(boxes, shares, header),
            "status": _status_message(estimate, header, total, len(boxes)),
        }
        if self._take(estimate):
            found["path"] = self.path(stamp_ns)
        return found

    def path(self, stamp_ns: int) -> ros.Path:
        """The trajectory so far, its last poses revised by what followed; frames that were lost are left out."""
        poses = [ros.PoseStamped(self._header(ros.nanoseconds(time_s)), pose) for time_s, pose in self._path]
        return ros.Path(self._header(stamp_ns), poses)

    def _header(self, stamp_ns: int) -> ros.Header:
        return ros.Header(ros.Time.of(stamp_ns), self.how.world_frame)

    def _take(self, estimate: Estimate) -> bool:
        """Add the pose to the path; where the path is to be published, also revise its last poses."""
        if estimate.pose is None:
            return False
        if is_lost(estimate):
            self._lost.add(estimate.timestamp_s)
        due = self._n_answered % self.how.path_every == 0
        revised = (estimate.revised if due else None) or estimate.pose  # hindsight takes time
        first = float(revised.timestamps_s[0])
        if due:
            self._lost = {time_s for time_s in self._lost if time_s >= first}
        while self._path and self._path[-1][0] >= first:
            self._path.pop()
        for time_s, pose in zip(revised.timestamps_s.tolist(), _poses(revised), strict=True):
            if time_s not in self._lost:
                self._path.append((time_s, pose))
        self._n_answered += 1
        return due


def _poses(trajectory: Trajectory) -> list[ros.Pose]:
    pairs = zip(trajectory.positions_xyz, trajectory.orientations_quat_wxyz, strict=True)
    return [ros.Pose.of(position, quat) for position, quat in pairs]
