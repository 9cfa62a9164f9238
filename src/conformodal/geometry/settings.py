"""Settings of triangulation, adjustment and camera fit that are chosen, not learnt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class _TriangulationSettings:
    """Robust triangulation of landmarks."""

    min_parallax_rad: float = float(np.radians(2.5))
    iterations: int = 4
    doubt: float = 0.4  # share of the tolerance above which residuals are downweighted


@dataclass(frozen=True)
class _CameraFitSettings:
    """Camera calibration from known poses."""

    most: int = 10000  # matches: half are fitted, half check the fit
    least: int = 400
    scale_px: float = 1.5  # of the Cauchy loss
    sigma_log_focal: float = 0.2  # prior standard deviation of the logarithm of the focal length
    sigma_mount_rad: float = 0.05  # of the mount's angles
    sigma_mount_depths: float = 0.05  # of the mount's position, in scene depths
    sigma_s: float = 0.02  # of the shutter's delays
    most_sigmas: float = 3.0  # further off, the poses do not belong to the images


@dataclass(frozen=True)
class _AdjustmentSettings:
    """Bundle adjustment of the map."""

    rounds: int = 2  # of triangulation and adjustment; sigmas and mount are learnt after each
    iterations: int = 8
    dampings: int = 8  # tried in one iteration
    enough: float = 3e-3  # share of the cost below which an iteration ends it
    # residual, as a share of the gradient, at which a step is solved, and steps of the solver. With 1e-2 to 1e-4 maps
    # localise alike
    solved: float = 1e-2
    solving: int = 300
    tracks: int = 80  # of each frame, the longest first
    least_views: int = 3
    least_per_frame: float = 20.0  # observations, on average: with fewer, poses stay as given
    # standard deviations of the given poses at first, and how far they may fall
    sigma_rad: float = float(np.radians(1.0))
    sigma_depths: float = 0.01
    least_sigma: float = 0.05
    sigma_focal: float = 0.02  # of the logarithm of the focal length


@dataclass(frozen=True)
class _BundleSettings:
    """Of bundle adjustment (Triggs et al. 2000)."""

    iterations: int = 20  # at most
    dampings: int = 6  # tried per iteration, at most
    enough: float = 1e-5  # relative decrease of the cost that ends the search
    cauchy: float = 2.0  # standard deviations beyond which residuals are down-weighted
    nearest: float = 1e-3  # least depth in front of a camera, as a share of the anchor's


CAMERA_FIT, ADJUSTMENT, BUNDLE = _CameraFitSettings(), _AdjustmentSettings(), _BundleSettings()
TRIANGULATION = _TriangulationSettings()
