"""The positions of a region as boxes to draw."""

from __future__ import annotations

from itertools import product

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.running.estimates import Estimate

from . import messages as ros
from .conventions import Conventions, is_lost
from .covariance import weights_of

_COLOUR, _FAINTEST, _FULLEST = (86 / 255, 180 / 255, 233 / 255), 0.15, 0.8
_INTERVALS_AN_AXIS = 16


def region_boxes(estimate: Estimate, how: Conventions) -> tuple[FloatArray, FloatArray, int]:
    """Boxes of the region's positions, and how much of the belief lies in each.

    Returns
    -------
    boxes : (m, 3, 2) metres, lower and upper ends; none where the frame is lost, whose region is unbounded
    shares : (m,)
    total : how many boxes the region has
    """
    if is_lost(estimate) or estimate.region is None or estimate.pose is None or estimate.candidates is None:
        return np.empty((0, 3, 2)), np.empty(0), 0
    here, found = estimate.pose.positions_xyz[0], estimate.candidates
    parts = estimate.region.intervals(0)[:3]
    total = int(np.prod([len(part) for part in parts]))
    near = [
        _nearest(np.clip(part, at - how.range_m, at + how.range_m), at) for part, at in zip(parts, here, strict=True)
    ]
    boxes = np.array(list(product(*near))).reshape(-1, 3, 2)
    places = found.positions_xyz[None]
    inside = ((places >= boxes[:, None, :, 0]) & (places <= boxes[:, None, :, 1])).all(axis=2)
    shares = inside @ weights_of(found)
    order = np.lexsort((np.linalg.norm(boxes.mean(axis=2) - here, axis=1), -shares))[: how.most_boxes]
    return boxes[order], shares[order], total


def _nearest(intervals: FloatArray, at: float) -> FloatArray:
    """The intervals (m, 2) that are nearest to a coordinate, so that their products stay few."""
    intervals = intervals[intervals[:, 1] > intervals[:, 0]]  # those out of range have shrunk to nothing
    away = np.maximum(np.maximum(intervals[:, 0] - at, at - intervals[:, 1]), 0)
    return intervals[np.sort(np.argsort(away, kind="stable")[:_INTERVALS_AN_AXIS])]


def region_message(boxes: FloatArray, shares: FloatArray, header: ros.Header) -> ros.MarkerArray:
    """Boxes to draw, the fuller the more of the belief they hold; those of the frame before are removed first."""
    markers = [ros.Marker(header, action=ros.Marker.DELETEALL)]
    for number, (box, share) in enumerate(zip(boxes, shares, strict=True)):
        middle, size = box.mean(axis=1).tolist(), np.ptp(box, axis=1).tolist()
        colour = ros.ColorRGBA(*_COLOUR, _FAINTEST + (_FULLEST - _FAINTEST) * float(share))
        pose = ros.Pose(ros.Point(*middle))
        markers.append(ros.Marker(header, "region", number, pose=pose, scale=ros.Vector3(*size), color=colour))
    return ros.MarkerArray(markers)
