import numpy as np
import pytest

from conformodal.corridor import CAMERA, Renderer, same_views, write_corridor, write_passes
from conformodal.corridor.flight import drone_pass, drone_path, rotation_world_cam
from conformodal.corridor.world import MODULE_LENGTH, CorridorWorld
from conformodal.io import read_recording


@pytest.fixture(scope="module")
def renderer():
    return Renderer(CorridorWorld(5, seed=0))


def pose(x, y, yaw_deg, z=1.3):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_world_cam(np.radians(yaw_deg))[0]
    matrix[:3, 3] = x, y, z
    return matrix


def test_camera_looks_along_its_yaw_with_down_down():
    r = rotation_world_cam(np.radians(90))[0]
    np.testing.assert_allclose(r @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(r @ [0, 1, 0], [0, 0, -1], atol=1e-12)
    up = rotation_world_cam(0.0, pitch=0.2)[0]
    assert (up @ [0, 0, 1])[2] > 0
    rolled = rotation_world_cam(0.0, roll=0.2)[0]
    assert (rolled @ [1, 0, 0])[2] < 0


def test_a_landmark_is_seen_where_the_pinhole_says(renderer):
    # the painting hangs at x 11.1 to 11.9, z 0.9 to 1.9 on the wall y = 0; look at it from the hall
    view = pose(11.5, 1.8, -90)
    shifted = view.copy()
    shifted[0, 3] -= MODULE_LENGTH  # the same wall, one module on, without the painting
    changed = np.abs(renderer.render(view).astype(int) - renderer.render(shifted)).max(axis=2) > 8
    rows, columns = np.nonzero(changed)
    corners = np.array([[11.1, 0.02, 0.9], [11.9, 0.02, 1.9]])
    cam = (corners - view[:3, 3]) @ view[:3, :3]
    pixels = cam[:, :2] / cam[:, 2:] * CAMERA.fx + (CAMERA.cx, CAMERA.cy)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    assert columns.min() == pytest.approx(low[0], abs=2)
    assert columns.max() == pytest.approx(high[0], abs=2)
    assert rows.min() == pytest.approx(low[1], abs=2)
    assert rows.max() == pytest.approx(high[1], abs=2)


def test_views_repeat_by_modules_except_for_landmarks(renderer):
    alike = same_views(renderer, pose(2.0, 3.3, 90))  # in the first room, which has no landmark
    assert (alike[:, 0, 3] - 2.0).tolist() == [8.0, 12.0, 16.0]  # not the second room: it has the poster
    assert len(same_views(renderer, pose(6.0, 3.3, 90))) == 0  # the room with the poster
    assert len(same_views(renderer, pose(1.0, 1.1, 180))) == 0  # the west end
    for other in alike:
        difference = np.abs(renderer.render(other).astype(int) - renderer.render(pose(2.0, 3.3, 90)))
        assert (difference > 1).mean() < 1e-3  # rounding, at a few edges


@pytest.mark.parametrize("way", ["lap", "pass"])
def test_the_drone_stays_clear_of_walls(renderer, way):
    world = renderer.world
    path = drone_path(world, n_laps=1, seed=1) if way == "lap" else drone_pass(world, seed=1)
    steps = np.diff(path.positions_xyz, axis=0)
    length = np.linalg.norm(steps, axis=1)
    origins, headings = path.positions_xyz[:-1], steps / length[:, None]
    hits, rays, _ = world.mesh.ray.intersects_location(origins, headings, multiple_hits=False)
    distance = np.linalg.norm(hits - origins[rays], axis=1)
    assert (distance > length[rays] + 0.1).all()
    assert length.max() < 0.5


def test_writing_is_reproducible_and_readable(tmp_path, monkeypatch):
    exact = drone_path(CorridorWorld(2, seed=5), 1, 5)
    monkeypatch.setattr("conformodal.corridor.flight.drone_path", lambda *flight: drone_path(*flight)[:9])
    told = []
    for name in ("a", "b"):
        write_corridor(tmp_path / name, n_modules=2, n_laps=1, seed=5, progress=lambda *now: told.append(now))
    assert told[-1] == (9, 9)
    a, b = read_recording(tmp_path / "a"), read_recording(tmp_path / "b")
    np.testing.assert_array_equal(a.image(7), b.image(7))
    np.testing.assert_allclose(a.require_truth().positions_xyz, exact.positions_xyz[:9], atol=1e-9)
    assert a.camera == CAMERA
    assert a.timestamps_s[1] == pytest.approx(0.1)


def test_passes_differ_and_are_reproducible(tmp_path):
    for name in ("one", "other"):
        write_passes(tmp_path / name, n_modules=2, n_passes=2, seed=5, speed=8.0)
    passes, again = (read_recording(tmp_path / name) for name in ("one", "other"))
    assert np.bincount(passes.recording).tolist() == [len(passes) // 2] * 2
    first, second = np.split(passes.require_truth().positions_xyz, 2)
    assert first[0, 0] < 2 < 5.5 < first[-1, 0]  # from end to end of 8 m
    assert 0.01 < np.abs(first - second).max() < 0.5  # the same way, with other gusts
    for i in (0, len(passes) - 1):
        np.testing.assert_array_equal(passes.image(i), again.image(i))


def test_a_faster_flight_has_fewer_frames_of_the_same_way():
    slow, fast = (drone_path(CorridorWorld(2), 1, speed=speed).positions_xyz for speed in (1.0, 2.0))
    assert len(fast) == pytest.approx(len(slow) / 2, abs=1)
    np.testing.assert_allclose(fast.max(axis=0), slow.max(axis=0), atol=0.4)


def test_passes_that_are_there_are_not_flown_again(tmp_path):
    write_passes(tmp_path, n_modules=2, n_passes=1, seed=5, speed=8.0)
    first = sorted((tmp_path / "seq-01").iterdir())[0]
    written = first.stat().st_mtime_ns
    write_passes(tmp_path, n_modules=2, n_passes=2, seed=5, speed=8.0)
    assert first.stat().st_mtime_ns == written
    assert len(np.unique(read_recording(tmp_path).recording)) == 2
