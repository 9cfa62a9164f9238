"""Settings of adjustment that are chosen, not learnt."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class _SolverSettings:
    """Levenberg-Marquardt of bundle adjustment."""

    damping: float = 1e-4  # at first
    least_damping: float = 1e-9
    dampings: int = 8  # tried in one iteration
    few_cameras: int = 16  # up to which the equations of cameras are solved directly
    # residual, as a share of the gradient, at which conjugate gradients end. With 1e-2 to 1e-4 maps localise alike
    cg_tolerance: float = 1e-2
    cg_iterations: int = 300
    nearest: float = 1e-6  # least depth in front of a camera
    regular: float = 1e-9  # added to diagonals
    fixed: float = 1e-9  # sigma of what does not change


@dataclass(frozen=True)
class _MapPosesSettings:
    """Adjustment of a map's poses."""

    rounds: int = 2  # of triangulation and adjustment; sigmas and mount are learnt after each
    iterations: int = 8
    enough: float = 3e-3  # share of the cost below which an iteration ends it
    tracks: int = 80  # of each frame, the longest first
    least_views: int = 3
    least_per_frame: float = 20.0  # observations, on average: with fewer, poses stay as given
    # standard deviations of the given poses at first, and how far they may fall
    sigma_rad: float = float(np.radians(1.0))
    sigma_depths: float = 0.01
    least_sigma: float = 0.05
    sigma_focal: float = 0.02  # of the logarithm of the focal length


SOLVER, MAP_POSES = _SolverSettings(), _MapPosesSettings()
