import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conformodal.conformal import grouped_maximum_quantile, grouped_quantile
from conformodal.odometry import (
    OdometryError,
    OdometryRun,
    PoseRadius,
    Promise,
    Sizing,
    fit_pose_radius,
    pose_errors,
    recording_errors,
    recording_size,
    recording_sizes,
    recordings_needed,
    roughness,
)
from conformodal.poses import Trajectory, concatenate


def trajectory(n, seed):
    rng = np.random.default_rng(seed)
    return Trajectory(np.arange(float(n)), rng.normal(size=(n, 3)), Rotation.random(n, rng).as_quat(scalar_first=True))


def test_errors_are_distances_and_angles():
    a = trajectory(4, 0)
    turned = Rotation.from_quat(a.orientations_quat_wxyz, scalar_first=True) * Rotation.from_rotvec([0, 0.3, 0])
    b = Trajectory(a.timestamps_s, a.positions_xyz + np.array([0, 3, 4]), -turned.as_quat(scalar_first=True))
    position, angle = pose_errors(b, a)
    np.testing.assert_allclose(position, 5)
    np.testing.assert_allclose(angle, 0.3)


def test_one_threshold_holds_the_larger_of_both_errors():
    rng = np.random.default_rng(1)
    errors = [(rng.random(k), rng.random(k)) for k in rng.integers(2, 9, 30)]
    sizes = rng.uniform(0.5, 2, 30)
    for promise, quantile in ((Promise.FRAME, grouped_quantile), (Promise.RECORDING, grouped_maximum_quantile)):
        radius = fit_pose_radius(errors, 0.2, promise, "smoothed", metres_per_rad=4.0, sizes=list(sizes))
        scores = [np.maximum(m / 4, r) / size for (m, r), size in zip(errors, sizes, strict=True)]
        assert radius.radius_rad == quantile(scores, 0.2)
        assert radius.radius_m == 4 * radius.radius_rad
        assert radius.degrees(0.5) == pytest.approx(np.degrees(radius.radius_rad) / 2)
        assert radius.degrees(1000) == 180
        assert radius.n_recordings == 30
    assert radius.radius_m > fit_pose_radius(errors, 0.2, Promise.FRAME, "smoothed", metres_per_rad=4.0).radius_m


def test_nine_recordings_suffice_for_a_tenth():
    assert [recordings_needed(alpha) for alpha in (0.1, "0.05", 0.3, 0.5)] == [9, 19, 3, 1]
    rng = np.random.default_rng(2)
    errors = [(rng.random(5), rng.random(5)) for _ in range(9)]
    for promise in Promise:
        assert fit_pose_radius(errors[:8], 0.1, promise, "smoothed").radius_rad == np.inf
        assert np.isfinite(fit_pose_radius(errors, 0.1, promise, "smoothed").radius_rad)


def recording_of_a_shaky_camera(rng):
    """Answers to a recording of random length and difficulty, and the truth; the errors of one recording agree."""
    n = int(rng.integers(5, 40))
    noise = np.exp(rng.normal(-3, 0.7))
    times = np.arange(float(n))
    path = np.cumsum(rng.normal(size=(n, 3)) * 0.01, axis=0)
    off = noise * (rng.normal(size=3) + rng.normal(size=(n, 3)))
    turned = Rotation.from_rotvec(noise / 4 * (rng.normal(size=3) + rng.normal(size=(n, 3))))
    truth = Trajectory(times, path, np.tile([1.0, 0, 0, 0], (n, 1)))
    return Trajectory(times, path + off, turned.as_quat(scalar_first=True)), truth


def test_a_frame_of_a_new_recording_is_held_as_often_as_promised():
    rng = np.random.default_rng(3)
    alpha, held = 0.2, {sizing: [] for sizing in Sizing}
    for _ in range(400):
        recordings = [recording_of_a_shaky_camera(rng) for _ in range(12)]
        errors = [pose_errors(*pair) for pair in recordings[1:]]
        estimate, truth = recordings[0]
        for sizing in Sizing:
            sizes = [recording_size(answers, sizing, alpha, 3.0) for answers, _ in recordings[1:]]
            radius = fit_pose_radius(
                errors, alpha, Promise.FRAME, "smoothed", metres_per_rad=3.0, sizing=sizing, sizes=sizes
            )
            held[sizing].append(radius.holds(estimate, truth, radius.size_of(estimate)).mean())
    for shares in held.values():
        # promised in the mean; above it by at most one recording's weight
        slack = 3 * np.std(shares) / np.sqrt(len(shares))
        assert 1 - alpha - slack < np.mean(shares) < 1 - alpha + 1 / 12 + slack
    # what is worst of all recordings is held more often by a radius that knows which are hard
    assert np.quantile(held[Sizing.ROUGHNESS], 0.05) > np.quantile(held[Sizing.NONE], 0.05)


def test_roughness_is_the_distance_from_what_the_neighbours_say():
    times = np.array([0.0, 1, 3, 4, 5])
    turns = Rotation.from_rotvec(np.outer(0.1 * times, [0, 1, 0]))
    steady = Trajectory(times, np.outer(times, [1, 2, 3]), turns.as_quat(scalar_first=True))
    np.testing.assert_allclose(roughness(steady), 0, atol=1e-12)
    places = steady.positions_xyz.copy()
    places[1] += [0.3, 0, 0.4]
    moved = Trajectory(times, places, steady.orientations_quat_wxyz)
    # of frame 2 a third of the way from frame 3 to frame 1
    np.testing.assert_allclose(roughness(moved, 2.0), [0.25, 0.25 / 3, 0], atol=1e-12)
    turned = (turns * Rotation.from_rotvec([[0, 0, 0], [0, 0, 0], [0, 0.2, 0], [0, 0, 0], [0, 0, 0]])).as_quat(
        scalar_first=True
    )
    np.testing.assert_allclose(
        roughness(Trajectory(times, steady.positions_xyz, turned)), [0.2 / 3, 0.2, 0.1], atol=1e-12
    )
    assert roughness(steady[:2]).size == 0


def test_a_rougher_recording_has_a_larger_size():
    calm = trajectory(50, 4)
    rough = Trajectory(calm.timestamps_s, 16 * calm.positions_xyz, calm.orientations_quat_wxyz)
    size = [recording_size(t, Sizing.ROUGHNESS, 0.1, 1e-3) for t in (calm, rough)]
    assert size[1] == pytest.approx(2 * size[0])  # a fourth root
    still = Trajectory(np.arange(5.0), np.zeros((5, 3)), np.tile([1.0, 0, 0, 0], (5, 1)))
    assert 0 < recording_size(still, Sizing.ROUGHNESS, 0.1) < 0.2
    assert recording_size(rough[:2], Sizing.ROUGHNESS, 0.1) == recording_size(rough, Sizing.NONE, 0.1) == 1
    radius = PoseRadius(0.1, 0.1, Promise.FRAME, "smoothed", 9, sizing=Sizing.ROUGHNESS)
    both = concatenate([calm, still])
    numbers = np.repeat([7, 2], [50, 5])
    expected = np.repeat([radius.size_of(calm), radius.size_of(still)], [50, 5])
    np.testing.assert_array_equal(radius.sizes_of(both, numbers), expected)
    with pytest.raises(OdometryError, match="55 poses need the numbers of their recordings, got 54"):
        radius.sizes_of(both, numbers[1:])


def test_sizes_that_are_none_are_refused():
    errors = [([0.1], [0.1])] * 9
    for sizes in ([0.0] * 9, [np.inf] * 9, [np.nan] * 9):
        with pytest.raises(OdometryError, match="sizes must be positive and finite"):
            fit_pose_radius(errors, 0.1, Promise.FRAME, "smoothed", sizes=sizes)
    with pytest.raises(OdometryError, match="9 recordings need as many sizes, got 8"):
        fit_pose_radius(errors, 0.1, Promise.FRAME, "smoothed", sizes=[1.0] * 8)
    with pytest.raises(OdometryError, match="metres_per_rad must be positive and finite, got nan"):
        fit_pose_radius(errors, 0.1, Promise.FRAME, "smoothed", metres_per_rad=float("nan"))


def test_the_radius_holds_both_errors_or_not():
    truth = trajectory(3, 2)
    turn = Rotation.from_quat(truth.orientations_quat_wxyz, scalar_first=True)
    turned = turn * Rotation.from_rotvec([[0, 0, 0.1], [0, 0, 0.3], [0, 0, 0.1]])
    moved = truth.positions_xyz + np.array([[0.1, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    radius = fit_pose_radius([([0.2], [0.2])] * 9, 0.5, Promise.FRAME, "smoothed", metres_per_rad=1.0)
    estimate = Trajectory(truth.timestamps_s, moved, turned.as_quat(scalar_first=True))
    assert radius.holds(estimate, truth).tolist() == [True, False, False]
    assert radius.holds(estimate, truth, [1, 2, 2]).all()
    assert radius.holds(estimate, truth, [0.4, 2, 1]).tolist() == [False, True, False]
    assert "a frame drawn at random" in radius.assumption


def test_frames_that_could_not_be_read_are_infinitely_far_off():
    truth = trajectory(6, 3)
    run = OdometryRun(np.array([0, 1, 3, 4, 5]), truth.timestamps_s[[0, 1, 3, 4, 5]], None, [], [], [], {})
    run.trajectories["smoothed"] = truth[np.array([0, 1, 3, 4, 5])]
    errors = recording_errors(run, "smoothed", truth, np.array([0, 0, 0, 1, 1, 1]))
    assert [e[0].tolist() for e in errors] == [[0, 0, np.inf], [0, 0, 0]]
    sizes = recording_sizes(run, "smoothed", np.array([0, 0, 0, 1, 1, 1]), Sizing.ROUGHNESS, 0.1)
    assert sizes == [1, recording_size(truth[np.array([3, 4, 5])], Sizing.ROUGHNESS, 0.1)]
    assert fit_pose_radius(errors, 0.45, Promise.RECORDING, "smoothed").radius_m == np.inf
    assert fit_pose_radius(errors, 0.9, Promise.FRAME, "smoothed").radius_m == pytest.approx(0)
