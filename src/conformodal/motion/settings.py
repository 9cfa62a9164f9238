"""Every number that motion was given and did not learn, with its unit and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class _TrackerSettings:
    """How corners are found and followed.

    Attributes
    ----------
    max_corners
        Corners kept alive.
    harris_k
        Weight of the squared trace in the Harris response.
    quality
        Weakest Harris response, relative to the strongest.
    spacing_share
        Least distance between new corners, as a share of the image width.
    renew_below
        New corners are sought when fewer than this share of `max_corners` are left.
    window_px, levels
        Lucas-Kanade window and pyramid levels above the image.
    back_levels
        Levels on the way back, which starts from where the corner was.
    max_back_error_px
        Largest distance between a corner and itself tracked forth and back.
    """

    max_corners: int = 500
    harris_k: float = 0.04
    quality: float = 1e-4
    spacing_share: float = 0.025
    renew_below: float = 0.85
    window_px: int = 11
    levels: int = 4
    back_levels: int = 1
    max_back_error_px: float = 0.7


@dataclass(frozen=True)
class _RelativePoseSettings:
    """When a relative motion is measured, and how uncertain it is.

    Attributes
    ----------
    min_tracks
        Followed corners below which nothing is measured.
    min_inlier_share
        Of the corners, below which the geometry does not fit.
    repeated_flow_px
        Median displacement below which nothing has moved: a repeated picture, or a camera at rest.
    plane_ambiguity_rad
        Two motions that one plane allows are two answers if their directions differ by more than this.
    turning_share
        Share of the corners that a rotation alone must explain for the pair to be one.
    min_parallax_px
        Parallax below this is lost in the tracker's own error.
    plane_share
        Share of the corners that one plane must explain.
    behind
        Plane distances by which a corner may fall behind a camera through tracking error alone.
    remark_below
        Share of the marked corners left below which a rotation is chained from here on: the corners that last longest
        drift most.
    epipolar_px
        Largest distance from an epipolar line.
    ransac, refinement
        Of PoseLib; corners drift by a few tenths of a pixel, so a quarter is where the final fit doubts one.
    farthest
        Steps beyond which OpenCV does not count a point as in front of both cameras.
    """

    min_tracks: int = 16
    min_inlier_share: float = 0.5
    repeated_flow_px: float = 0.05
    plane_ambiguity_rad: float = float(np.radians(5.0))
    turning_share: float = 0.9
    min_parallax_px: float = 1.0
    plane_share: float = 0.97
    behind: float = -1e-3
    remark_below: float = 0.5
    epipolar_px: float = 1.0
    ransac: dict[str, Any] = field(
        default_factory=lambda: {"max_epipolar_error": 1.0, "max_iterations": 1000, "min_iterations": 20, "seed": 0}
    )
    refinement: dict[str, Any] = field(
        default_factory=lambda: {"loss_type": "CAUCHY", "loss_scale": 0.25, "max_iterations": 20}
    )
    farthest: float = 1e4


@dataclass(frozen=True)
class _MotionErrorSettings:
    """Standard deviations of a relative motion, from the scatter between parts of the image.

    Attributes
    ----------
    columns, rows
        Parts of the image.
    rotation_factor, direction_factor
        Errors over what the scatter predicts (benchmarks/relative_motion.py).
    least_residual_px
        No corner is followed better than this.
    """

    columns: int = 4
    rows: int = 3
    rotation_factor: float = 2.4
    direction_factor: float = 3.0
    least_residual_px: float = 0.05


@dataclass(frozen=True)
class _SubmapSettings:
    """Where a submap ends, and how uncertain it is.

    Attributes
    ----------
    min_share, min_corners
        It ends where fewer of its corners are left.
    max_span
        Frames.
    max_cameras
        The anchor included; frames between these say little more.
    max_corners
        That are triangulated.
    position_factor, rotation_factor
        Errors over what the corners' residuals predict (benchmarks/submaps.py): rolling shutter and drift are common
        to all corners.
    worst_sigma
        Predicted standard deviation, as a share of the longest distance, above which a submap is dropped.
    sigma_px, least_residual_px
        Of a corner.
    agree_px, min_agreeing
        A frame agrees where this share of its corners is reprojected within so many pixels.
    ransac, refinement
        Of PoseLib.
    """

    min_share: float = 0.3
    min_corners: int = 40
    max_span: int = 60
    max_cameras: int = 9
    max_corners: int = 250
    position_factor: float = 4.5
    rotation_factor: float = 35.0
    worst_sigma: float = 0.5
    sigma_px: float = 0.5
    least_residual_px: float = 0.1
    agree_px: float = 2.0
    min_agreeing: float = 0.6
    ransac: dict[str, Any] = field(
        default_factory=lambda: {"max_reproj_error": 3.0, "max_iterations": 200, "min_iterations": 10, "seed": 0}
    )
    refinement: dict[str, Any] = field(default_factory=lambda: {"loss_type": "CAUCHY", "loss_scale": 0.5})


@dataclass(frozen=True)
class _BundleSettings:
    """Of bundle adjustment (Triggs et al. 2000).

    Attributes
    ----------
    iterations, dampings
        At most; dampings are tried in one iteration.
    enough
        Relative decrease of the cost that ends the search.
    cauchy
        Standard deviations beyond which a residual loses its pull.
    nearest
        Least depth in front of a camera, as a share of the anchor's.
    """

    iterations: int = 20
    dampings: int = 6
    enough: float = 1e-5
    cauchy: float = 2.0
    nearest: float = 1e-3


TRACKER = _TrackerSettings()
RELATIVE_POSE, MOTION_ERRORS = _RelativePoseSettings(), _MotionErrorSettings()
SUBMAPS, BUNDLE = _SubmapSettings(), _BundleSettings()
