"""Settings of relative motion and submaps: numbers that were chosen, not learnt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class _RelativePoseSettings:
    """When a relative motion is measured, and how uncertain it is."""

    min_tracks: int = 16  # tracked corners
    essential_corners: int = 5  # that an essential matrix needs
    min_inlier_share: float = 0.5
    repeated_flow_px: float = 0.05  # median displacement below which the picture is repeated or the camera at rest
    plane_ambiguity_rad: float = float(np.radians(5.0))  # between the two directions that a plane allows
    rotation_rounds: int = 5  # of the trimmed fit of a rotation
    turning_share: float = 0.9  # of the corners that a rotation alone must explain to be the answer
    min_parallax_px: float = 1.0  # below this, parallax is lost in tracking errors
    plane_share: float = 0.97  # of the corners that one plane must explain
    behind: float = -1e-3  # plane distances by which tracking errors may put a corner behind a camera
    # share of the marked corners below which rotations are chained from here on: the longest tracks drift most
    remark_below: float = 0.5
    epipolar_px: float = 1.0  # largest distance from an epipolar line
    ransac: dict[str, Any] = field(
        default_factory=lambda: {"max_epipolar_error": 1.0, "max_iterations": 1000, "min_iterations": 20, "seed": 0}
    )
    # corners drift by a few tenths of a pixel: the final fit gives those beyond a quarter less weight
    refinement: dict[str, Any] = field(
        default_factory=lambda: {"loss_type": "CAUCHY", "loss_scale": 0.25, "max_iterations": 20}
    )
    farthest: float = 1e4  # steps beyond which OpenCV does not count a point as in front of both cameras


@dataclass(frozen=True)
class _MotionErrorSettings:
    """Standard deviations of a relative motion, from the scatter between parts of the image."""

    columns: int = 4  # parts of the image
    rows: int = 3
    rotation_factor: float = 2.4  # errors over what the scatter predicts (benchmarks/relative_motion.py)
    direction_factor: float = 3.0
    least_residual_px: float = 0.05  # no corner is tracked better than this


@dataclass(frozen=True)
class _SubmapSettings:
    """Where a submap ends, and how uncertain it is."""

    min_share: float = 0.3  # it ends where a smaller share of its corners is left, or fewer than min_corners
    min_corners: int = 40
    max_span: int = 60  # frames
    max_cameras: int = 9  # the anchor included; frames between these add little
    max_corners: int = 250  # that are triangulated
    # errors over what the residuals predict (benchmarks/submaps.py): rolling shutter and drift are common to all
    position_factor: float = 4.5
    rotation_factor: float = 35.0
    worst_sigma: float = 0.5  # predicted standard deviation over the longest distance, above which a submap is dropped
    sigma_px: float = 0.5  # of a corner
    least_residual_px: float = 0.1
    cauchy: float = 2.8  # sigmas beyond which residuals are down-weighted
    iterations: int = 20  # of bundle adjustment, at most
    enough: float = 1e-5  # relative decrease of the cost that ends it
    agree_px: float = 2.0  # a corner agrees if it is reprojected within this
    min_agreeing: float = 0.6  # share of the corners
    ransac: dict[str, Any] = field(
        default_factory=lambda: {"max_reproj_error": 3.0, "max_iterations": 200, "min_iterations": 10, "seed": 0}
    )
    refinement: dict[str, Any] = field(default_factory=lambda: {"loss_type": "CAUCHY", "loss_scale": 0.5})


RELATIVE_POSE, MOTION_ERRORS = _RelativePoseSettings(), _MotionErrorSettings()
SUBMAPS = _SubmapSettings()
