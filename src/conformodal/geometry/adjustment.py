"""Bundle adjustment (Triggs et al. 2000): cameras and points that fit their observations best.

One solver for maps of hundreds of frames and for submaps of nine. Levenberg-Marquardt with Cauchy weights; the Schur
complement removes the points. The unknowns left are solved for directly where cameras are few, and by conjugate
gradients (Agarwal et al. 2010) without forming their matrix where they are many. Robust statistics stand beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray, IntArray

# Of standard normal variables: the median absolute value; the median length of a vector in two and in three
# dimensions; and the 95th percentile of the latter.
MAD_OF_NORMAL = 0.6745
MEDIAN_OF_NORM2, MEDIAN_OF_NORM3, TAIL_OF_NORM3 = 1.177, 1.5382, 2.7955
_CAUCHY = 2.0  # Cauchy's scale in standard deviations: larger residuals get less weight

# Which of the four homogeneous coordinates of points are unknown. One inverse depth per point is well behaved far away
# (Civera et al. 2008), where the ray from one of the cameras is known.
POSITIONS, INVERSE_DEPTHS = slice(0, 3), slice(3, 4)

_Matrix: TypeAlias = Any  # sparse or dense, which one operator multiplies alike

_NEAREST = 1e-6  # least depth in front of a camera
_REGULAR = 1e-9  # added to diagonals
_FIXED = 1e-9  # sigma of what does not change


def cauchy(residual: FloatArray) -> FloatArray:
    """Cauchy weights (n,) of residuals in standard deviations."""
    return np.asarray(1 / (1 + (residual / _CAUCHY) ** 2))


class Bundle(NamedTuple):
    """Cameras and points."""

    R_world_cam: FloatArray  # (n, 3, 3)
    centres: FloatArray  # (n, 3)
    points: FloatArray  # (p, 4) homogeneous: a position and 1, or a direction and an inverse depth along it
    log_focal: float = 0.0  # change of the focal length


class ObservedCorners(NamedTuple):
    """Which camera sees which point where; a camera sees a point at most once."""

    camera: IntArray  # (m,) increasing
    point: IntArray  # (m,)
    plane: FloatArray  # (m, 2) on the plane at depth 1

    def starts(self, n_cameras: int) -> IntArray:
        """Index (n + 1,) of the first observation of each camera, and of the end."""
        return np.searchsorted(self.camera, np.arange(n_cameras + 1))

    def sum_by_point(self, values: FloatArray, n_points: int) -> FloatArray:
        """Sums (p, ...) of values (m, ...) of observations."""
        m = len(self.point)
        adding = sparse.csr_array((np.ones(m), (self.point, np.arange(m))), shape=(n_points, m))
        return np.asarray(adding @ values.reshape(m, -1)).reshape(n_points, *values.shape[1:])


class PosePriors(NamedTuple):
    """Where cameras are expected."""

    poses: FloatArray  # (n, 4, 4) ``T_world_cam``
    sigmas: FloatArray  # (6,), or (n, 6) of each camera: radians in the camera's frame, and metres

    def deviations(self, bundle: Bundle) -> FloatArray:
        """Rotation vectors and translations (n, 6) from the expected poses to those of a bundle."""
        turns = Rotation.from_matrix(np.swapaxes(self.poses[:, :3, :3], 1, 2) @ bundle.R_world_cam).as_rotvec()
        return np.concatenate((turns, bundle.centres - self.poses[:, :3, 3]), axis=1)


class Fit(NamedTuple):
    """A bundle and what it leaves unexplained."""

    bundle: Bundle
    local: FloatArray  # (m, 3) points in the frame of the camera that sees them, times their fourth coordinate
    residuals: FloatArray  # (m, 2) in sigmas
    deviations: FloatArray | None  # (n, 6) from the priors, in their sigmas
    cost: float


@dataclass(frozen=True)
class SolverSettings:
    """How the equations of an adjustment are solved."""

    damping: float = 1e-4  # of Levenberg-Marquardt, at first
    min_damping: float = 1e-9
    max_dampings: int = 8  # tried in one iteration
    max_direct_cameras: int = 16  # up to which the equations of cameras are solved directly
    # residual, as a share of the gradient, at which conjugate gradients end. With 1e-2 to 1e-4 maps localise alike
    cg_tolerance: float = 1e-2
    max_cg_iterations: int = 300


@dataclass(frozen=True, eq=False)
class Adjustment:
    """A problem of bundle adjustment."""

    observations: ObservedCorners
    sigma: float  # standard deviation of an observation on the plane at depth 1
    cauchy: float  # residuals larger than so many sigmas are down-weighted
    unknown: slice  # POSITIONS or INVERSE_DEPTHS
    iterations: int  # at most
    enough: float  # relative decrease of the cost that ends them
    priors: PosePriors | None = None
    focal_sigma: float = _FIXED  # standard deviation of the focal length's logarithm; by default it does not change
    solver: SolverSettings = SolverSettings()

    def solve(self, start: Bundle) -> Fit:
        """The bundle of least cost near a start."""
        fit, damping = self.evaluate(start), self.solver.damping
        for _ in range(self.iterations):
            equations = self._linearise(fit)
            for _ in range(self.solver.max_dampings):
                trial = self.evaluate(equations.step(fit.bundle, damping))
                if trial.cost <= fit.cost:
                    damping = max(damping / 10, self.solver.min_damping)
                    break
                damping *= 10
            else:
                return fit
            converged = fit.cost - trial.cost <= self.enough * fit.cost
            fit = trial
            if converged:
                break
        return fit

    def evaluate(self, bundle: Bundle) -> Fit:
        """Residuals of a bundle."""
        camera, point, plane = self.observations
        points = bundle.points[point]
        local = np.einsum(
            "mba,mb->ma", bundle.R_world_cam[camera], points[:, :3] - points[:, 3:] * bundle.centres[camera]
        )
        ahead = np.maximum(local[:, 2:], _NEAREST)
        residuals = (local[:, :2] / ahead * np.exp(bundle.log_focal) - plane) / self.sigma
        cost = self.cauchy**2 * np.log1p((residuals**2).sum(axis=1) / self.cauchy**2).sum()
        cost += (bundle.log_focal / self.focal_sigma) ** 2
        deviations = None if self.priors is None else self.priors.deviations(bundle) / self.priors.sigmas
        if deviations is not None:
            cost += (deviations**2).sum()
        return Fit(bundle, local, residuals, deviations, float(cost))

    def _linearise(self, fit: Fit) -> _NormalEquations:
        """Normal equations about a fit."""
        bundle, (camera, point, _) = fit.bundle, self.observations
        z = np.maximum(fit.local[:, 2], _NEAREST)
        x, y = fit.local[:, 0], fit.local[:, 1]
        u, v = x / z, y / z
        root = 1 / np.sqrt(1 + (fit.residuals**2).sum(axis=1) / self.cauchy**2)
        scale = (root * np.exp(bundle.log_focal) / (self.sigma * z))[:, None]
        # how the two coordinates of an observation change with the unknowns. R exp(turn) moves what the camera sees by
        # its cross product with the turn
        changes = np.empty((len(z), 2, 8))  # turn, centre, focal length; and the residual itself
        changes[:, 0, :3] = np.stack((u * y, -z - u * x, y), axis=1)
        changes[:, 1, :3] = np.stack((z + v * y, -v * x, -x), axis=1)
        axes = np.swapaxes(bundle.R_world_cam, 1, 2)[camera]
        by_position = scale[:, None] * (axes[:, :2] - np.stack((u, v), axis=1)[:, :, None] * axes[:, 2:])
        changes[:, :, :3] *= scale[:, None]
        changes[:, :, 3:6] = -bundle.points[point, 3, None, None] * by_position
        changes[:, :, 6] = scale * fit.local[:, :2]
        changes[:, :, 7] = root[:, None] * fit.residuals
        by_inverse_depth = -np.einsum("mka,ma->mk", by_position, bundle.centres[camera])
        by_point = np.concatenate((by_position, by_inverse_depth[:, :, None]), axis=2)[:, :, self.unknown]
        d = by_point.shape[2]

        products = _grams(changes, changes, self.observations.starts(len(bundle.centres)))
        cameras, gradients = products[:, :6, :6] + _REGULAR * np.eye(6), products[:, :6, 7]
        if self.priors is not None and fit.deviations is not None:
            cameras = cameras + (1 / self.priors.sigmas**2)[..., None] * np.eye(6)
            gradients = gradients + fit.deviations / self.priors.sigmas
        of_points = np.einsum("mka,mkb->mab", by_point, np.concatenate((by_point, changes[:, :, 6:]), axis=2))
        point_sums = self.observations.sum_by_point(of_points, len(bundle.points))
        return _NormalEquations(
            observations=self.observations,
            unknown=self.unknown,
            solver=self.solver,
            cameras=cameras,
            points=point_sums[:, :, :d],
            between=np.einsum("mka,mkb->mab", by_point, changes[:, :, :6]),
            focal=float(products[:, 6, 6].sum()) + 1 / self.focal_sigma**2,
            focal_cameras=products[:, :6, 6],
            focal_points=point_sums[:, :, d],
            camera_gradient=gradients,
            point_gradient=point_sums[:, :, d + 1],
            focal_gradient=float(products[:, 6, 7].sum()) + bundle.log_focal / self.focal_sigma**2,
        )


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Normal equations of cameras (6 unknowns each), points (d each) and focal length."""

    observations: ObservedCorners
    unknown: slice
    solver: SolverSettings
    cameras: FloatArray  # (n, 6, 6)
    points: FloatArray  # (p, d, d)
    between: FloatArray  # (m, d, 6) of a point and a camera
    focal: float
    focal_cameras: FloatArray  # (n, 6)
    focal_points: FloatArray  # (p, d)
    camera_gradient: FloatArray
    point_gradient: FloatArray
    focal_gradient: float

    def step(self, bundle: Bundle, damping: float) -> Bundle:
        """The bundle after a damped step."""
        n, (p, d) = len(self.cameras), self.focal_points.shape
        inverse = np.linalg.inv(_damped(self.points, damping) + _REGULAR * np.eye(d))
        # the points removed: what is left of cameras and focal length
        eliminated = inverse[self.observations.point] @ self.between
        through, back = self._matrix(eliminated), self._matrix(self.between).T
        focal_eliminated = np.einsum("pab,pb->pa", inverse, self.focal_points)
        reduced = _Reduced(
            cameras=_damped(self.cameras, damping),
            through=through,
            back=back,
            border=self.focal_cameras.ravel() - through @ self.focal_points.ravel(),
            corner=self.focal * (1 + damping) - float((focal_eliminated * self.focal_points).sum()),
        )
        gradient = np.append(
            self.camera_gradient.ravel() - through @ self.point_gradient.ravel(),
            self.focal_gradient - (focal_eliminated * self.point_gradient).sum(),
        )
        if n <= self.solver.max_direct_cameras:
            move = reduced.solve(-gradient)
        else:
            explained = _grams(eliminated, self.between, self.observations.starts(n))
            inverses = np.asarray(np.linalg.inv(reduced.cameras - explained))
            move = reduced.iterate(-gradient, inverses, self.solver)
        point_gradient = self.point_gradient + self.focal_points * move[-1] + (back @ move[:-1]).reshape(p, d)
        turn, shift = np.split(move[:-1].reshape(n, 6), 2, axis=1)
        points = bundle.points.copy()
        points[:, self.unknown] -= np.einsum("pab,pb->pa", inverse, point_gradient)
        return Bundle(
            bundle.R_world_cam @ Rotation.from_rotvec(turn).as_matrix(),
            bundle.centres + shift,
            points,
            bundle.log_focal + float(move[-1]),
        )

    def _matrix(self, blocks: FloatArray) -> _Matrix:
        """Blocks (m, d, 6) of points and cameras as a matrix (6 n, d p); dense if there are few cameras."""
        (camera, point, _), n, (p, d) = self.observations, len(self.cameras), self.focal_points.shape
        blocks = np.swapaxes(blocks, 1, 2)
        if n > self.solver.max_direct_cameras:
            return sparse.bsr_array((blocks, point, self.observations.starts(n)), shape=(6 * n, d * p)).tocsr()
        dense = np.zeros((n, 6, p, d))
        dense[camera, :, point] = blocks
        return dense.reshape(6 * n, d * p)


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Equations of cameras and focal length, ``cameras - through back`` with a border for the focal length."""

    cameras: FloatArray  # (n, 6, 6)
    through: _Matrix  # (6 n, d p)
    back: _Matrix  # (d p, 6 n)
    border: FloatArray  # (6 n,)
    corner: float

    def solve(self, right: FloatArray) -> FloatArray:
        """The solution (6 n + 1,) by elimination."""
        n = len(self.cameras)
        matrix = np.zeros((6 * n + 1, 6 * n + 1))
        matrix[:-1, :-1] = -(self.through @ self.back)
        for k, block in enumerate(self.cameras):
            matrix[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += block
        matrix[:-1, -1] = matrix[-1, :-1] = self.border
        matrix[-1, -1] = self.corner
        return np.asarray(np.linalg.solve(matrix, right))

    def iterate(self, right: FloatArray, inverses: FloatArray, solver: SolverSettings) -> FloatArray:
        """The solution by conjugate gradients, with the inverses (n, 6, 6) of the cameras' blocks as preconditioner."""
        n = len(self.cameras)

        def product(move: FloatArray) -> FloatArray:
            of_cameras = np.einsum("nab,nb->na", self.cameras, move[:-1].reshape(n, 6)).ravel()
            of_cameras += self.border * move[-1] - self.through @ (self.back @ move[:-1])
            return np.append(of_cameras, self.border @ move[:-1] + self.corner * move[-1])

        def precondition(move: FloatArray) -> FloatArray:
            of_cameras = np.einsum("nab,nb->na", inverses, move[:-1].reshape(n, 6)).ravel()
            return np.append(of_cameras, move[-1] / self.corner)

        operator, preconditioner = (
            LinearOperator((len(right), len(right)), work, dtype=np.float64) for work in (product, precondition)
        )
        move, _ = cg(operator, right, rtol=solver.cg_tolerance, maxiter=solver.max_cg_iterations, M=preconditioner)
        return np.asarray(move)


def _damped(blocks: FloatArray, damping: float) -> FloatArray:
    """Blocks (n, k, k) with a larger diagonal."""
    k = blocks.shape[1]
    return np.asarray(blocks + damping * np.einsum("nkk->nk", blocks)[:, None] * np.eye(k))


def _grams(left: FloatArray, right: FloatArray, starts: IntArray) -> FloatArray:
    """Sums of ``left^T right`` (n, a, b) over the rows (k, a) and (k, b) of each camera's observations."""
    grams = np.zeros((len(starts) - 1, left.shape[2], right.shape[2]))
    for gram, start, end in zip(grams, starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        gram[:] = left[start:end].reshape(-1, left.shape[2]).T @ right[start:end].reshape(-1, right.shape[2])
    return grams
