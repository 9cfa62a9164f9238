"""Absolute pose estimates of an image, each with its standard deviations and inlier probability."""

from __future__ import annotations

from dataclasses import dataclass

from conformodal.core.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class PoseMeasurement:
    """An absolute pose estimate of one image.

    Attributes
    ----------
    position_xyz, orientation_quat_wxyz
        (3,) metres and (4,): the camera's pose in the world, ``T_world_cam``.
    sigma_m, sigma_rad
        Standard deviations of its errors, per axis and about each axis.
    n_inliers
        Distinct observations that agree with the pose; a corner counts once.
    inlier_probability
        Probability that the estimate is no outlier. Of several estimates by one source, at most one is right, and each
        probability is stated as if the others were wrong.
    inlier_share
        Share of the matched observations that agree with the pose.
    image_share
        Share of the image over which these are spread.
    distance_to_known
        Distance to the nearest frame with a known pose, in scene depths plus radians; 0 where it is not measured.
    """

    position_xyz: FloatArray
    orientation_quat_wxyz: FloatArray
    sigma_m: float
    sigma_rad: float
    n_inliers: int
    inlier_probability: float = 1.0
    inlier_share: float = 1.0
    image_share: float = 1.0
    distance_to_known: float = 0.0
