import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from conformodal.geometry import rigid_motions
from conformodal.geometry.adjustment import (
    INVERSE_DEPTHS,
    POSITIONS,
    Adjustment,
    Bundle,
    ObservedCorners,
    PosePriors,
    SolverSettings,
)


def world(n_cameras=6, n_points=40, seed=0):
    """A bundle of cameras on a curve and points in front of them; the first camera is at the origin."""
    rng, t = np.random.default_rng(seed), np.arange(n_cameras)
    centres = np.column_stack((0.15 * t, 0.05 * np.sin(t), 0.05 * t))
    rotations = Rotation.from_rotvec(np.column_stack((0.01 * t, 0.03 * t, 0 * t))).as_matrix()
    points = np.column_stack((rng.uniform([-3, -2, 3], [3, 2, 7], (n_points, 3)), np.ones(n_points)))
    return Bundle(rotations, centres, points)


def observe(bundle, noise=0.0, hidden=0.1, seed=0):
    rng = np.random.default_rng(seed)
    n, p = len(bundle.centres), len(bundle.points)
    camera, point = np.nonzero(rng.random((n, p)) >= hidden)
    return ObservedCorners(camera, point, project(bundle, camera, point) + noise * rng.normal(size=(len(camera), 2)))


def project(bundle, camera, point):
    xyz, fourth = bundle.points[point, :3], bundle.points[point, 3:]
    local = np.einsum("mba,mb->ma", bundle.R_world_cam[camera], xyz - fourth * bundle.centres[camera])
    return local[:, :2] / local[:, 2:] * np.exp(bundle.log_focal)


def disturb(bundle, unknown, seed=1):
    rng = np.random.default_rng(seed)
    points = bundle.points.copy()
    points[:, unknown] *= 1 + 0.1 * rng.normal(size=points[:, unknown].shape)
    turns = Rotation.from_rotvec(0.01 * rng.normal(size=(len(bundle.centres), 3))).as_matrix()
    shifts = 0.02 * rng.normal(size=bundle.centres.shape)
    return Bundle(bundle.R_world_cam @ turns, bundle.centres + shifts, points)


def with_inverse_depths(bundle):
    """The other cameras, and points as directions and inverse depths in the first."""
    rays = bundle.points[:, :3] / bundle.points[:, 2:3]
    return Bundle(bundle.R_world_cam[1:], bundle.centres[1:], np.column_stack((rays, 1 / bundle.points[:, 2])))


def priors_of(bundle, sigma=1e-2):
    return PosePriors(rigid_motions(bundle.R_world_cam, bundle.centres), np.full(6, sigma))


@pytest.mark.parametrize("seed", range(3))
def test_submaps_without_noise_are_exact_up_to_their_length(seed):
    exact = with_inverse_depths(world(9, 200, seed))
    problem = Adjustment(observe(exact), 1e-3, 2.8, INVERSE_DEPTHS, 20, 1e-12)
    fit = problem.solve(disturb(exact, INVERSE_DEPTHS, seed))
    length = np.linalg.norm(fit.bundle.centres[-1]) / np.linalg.norm(exact.centres[-1])
    np.testing.assert_allclose(fit.bundle.centres / length, exact.centres, atol=1e-6)
    np.testing.assert_allclose(fit.bundle.R_world_cam, exact.R_world_cam, atol=1e-6)
    np.testing.assert_allclose(fit.bundle.points[:, 3] * length, exact.points[:, 3], rtol=1e-4)
    assert np.abs(fit.residuals).max() < 1e-3


@pytest.mark.parametrize("max_direct_cameras", [0, 100])  # by conjugate gradients, and directly
def test_maps_without_noise_are_exact_with_their_focal_length(max_direct_cameras):
    solver = SolverSettings(max_direct_cameras=max_direct_cameras)
    exact = world()._replace(log_focal=0.03)
    problem = Adjustment(observe(exact), 1e-3, 1.0, POSITIONS, 50, 1e-12, priors_of(exact), 1.0, solver)
    fit = problem.solve(disturb(exact, POSITIONS))
    np.testing.assert_allclose(fit.bundle.centres, exact.centres, atol=1e-4)
    np.testing.assert_allclose(fit.bundle.points, exact.points, atol=1e-3)
    assert fit.bundle.log_focal == pytest.approx(0.03, abs=1e-4)


@pytest.mark.parametrize("max_direct_cameras", [0, 100])
def test_solutions_agree_with_scipy(max_direct_cameras):
    solver = SolverSettings(max_direct_cameras=max_direct_cameras, cg_tolerance=1e-10)
    exact = world(3, 12)
    observations, priors = observe(exact, noise=1e-3), priors_of(exact)
    n, p, sigma, cauchy = 3, 12, 1e-3, 2.0
    fit = Adjustment(observations, sigma, cauchy, POSITIONS, 100, 0.0, priors, 0.01, solver).solve(exact)

    def residuals(x):
        turns, shifts, points = np.split(x[:-1], [3 * n, 6 * n])
        rotations = exact.R_world_cam @ Rotation.from_rotvec(turns.reshape(n, 3)).as_matrix()
        points = np.column_stack((points.reshape(p, 3), np.ones(p)))
        bundle = Bundle(rotations, exact.centres + shifts.reshape(n, 3), points, x[-1])
        off = (project(bundle, *observations[:2]) - observations.plane) / sigma
        size = np.linalg.norm(off, axis=1, keepdims=True)
        robust = off * cauchy * np.sqrt(np.log1p((size / cauchy) ** 2)) / size  # squares add up to Cauchy's loss
        return np.concatenate((robust.ravel(), (priors.deviations(bundle) / priors.sigmas).ravel(), [x[-1] / 0.01]))

    turns = Rotation.from_matrix(np.swapaxes(exact.R_world_cam, 1, 2) @ fit.bundle.R_world_cam).as_rotvec()
    shifts, points = fit.bundle.centres - exact.centres, fit.bundle.points[:, :3]
    solution = np.concatenate((turns.ravel(), shifts.ravel(), points.ravel(), [fit.bundle.log_focal]))
    best = least_squares(residuals, solution, method="lm", x_scale="jac")
    assert fit.cost == pytest.approx(2 * best.cost, rel=1e-6)
    np.testing.assert_allclose(solution, best.x, atol=1e-3)
    start = np.concatenate((np.zeros(6 * n), exact.points[:, :3].ravel(), [0.0]))
    assert fit.cost < 0.99 * (residuals(start) ** 2).sum()
