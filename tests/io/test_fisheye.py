"""Fisheye images are undistorted when they are read: dots land where the pinhole camera sees them."""

import json

import numpy as np
import pytest
from PIL import Image

from conformodal.geometry import PinholeCamera
from conformodal.io import DatasetError, DatasetWarning, read_recording

W, H = 160, 120
F = (62.0, 60.0, 81.5, 58.0)  # fx, fy, cx, cy
FROM_CORNER = (62.0, 60.0, 82.0, 58.5)  # as COLMAP and NeRF count pixels
K = (-0.05, 0.012, -0.004, 0.0007)
N = 3
pytestmark = pytest.mark.filterwarnings("ignore::conformodal.io.DatasetWarning")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("CONFORMODAL_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "undistorted"


GRID = np.stack(np.meshgrid(np.linspace(22, W - 22, 5), np.linspace(18, H - 18, 4)), axis=-1).reshape(-1, 2)


def seen_by_the_pinhole(f=F, k=K):
    """Where the pinhole camera sees what a pixel of the lens shows, (H, W, 2); the model, inverted by a table."""
    y, x = np.mgrid[:H, :W]
    u, v = (x - f[2]) / f[0], (y - f[3]) / f[1]
    bent, t = np.hypot(u, v), np.linspace(0, 1.5, 20001)
    angle = np.interp(bent, t + k[0] * t**3 + k[1] * t**5 + k[2] * t**7 + k[3] * t**9, t)
    share = np.tan(angle) / np.maximum(bent, 1e-12)
    return np.stack((f[0] * share * u + f[2], f[1] * share * v + f[3]), axis=-1)


def dots():
    """The lens's image of soft dots that are round in the pinhole camera's."""
    at = seen_by_the_pinhole()
    grey = sum(np.exp(-((at - place) ** 2).sum(axis=-1) / 5) for place in GRID)
    return np.repeat((255 * np.clip(grey, 0, 1)).astype(np.uint8)[..., None], 3, axis=2)


def centres(image, near):
    """Centres of brightness around places."""
    found = []
    for u, v in np.rint(near).astype(int):
        y, x = np.mgrid[v - 7 : v + 8, u - 7 : u + 8]
        weight = image[v - 7 : v + 8, u - 7 : u + 8, 0].astype(float)
        found.append(((weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()))
    return np.array(found)


def write_pictures(root, suffix=".png"):
    (root / "images").mkdir(parents=True)
    for i in range(N):
        picture = dots()
        picture[:6, :6] = 40 * i
        Image.fromarray(picture).save(root / "images" / f"{i:02d}{suffix}")
    return root


def write_colmap(root, numbers=(*FROM_CORNER, *K), size=(W, H)):
    write_pictures(root)
    place = root / "sparse" / "0"
    place.mkdir(parents=True)
    rows = [(i + 1, 1.0, 0.0, 0.0, 0.0, -0.5 * i, 0.0, 0.0, 1, f"{i:02d}.png") for i in range(N)]
    (place / "cameras.txt").write_text(f"1 OPENCV_FISHEYE {size[0]} {size[1]} {' '.join(map(str, numbers))}\n")
    (place / "images.txt").write_text("".join(" ".join(map(str, row)) + "\n\n" for row in rows))
    return root


def write_nerf(root, change=None):
    write_pictures(root)
    poses = np.tile(np.diag([1.0, -1, -1, 1]), (N, 1, 1))
    poses[:, 0, 3] = 0.5 * np.arange(N)
    content = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"), (*FROM_CORNER, *K), strict=True))
    content |= {"w": W, "h": H, "camera_model": "OPENCV_FISHEYE"} | (change or {})
    content["frames"] = [{"file_path": f"images/{i:02d}.png", "transform_matrix": poses[i].tolist()} for i in range(N)]
    (root / "transforms.json").write_text(json.dumps(content))
    return root


WRITERS = {
    "colmap": write_colmap,
    "nerf": write_nerf,
}


@pytest.mark.parametrize("kind", WRITERS)
def test_dots_land_where_the_pinhole_camera_sees_them(tmp_path, kind):
    sequence = read_recording(WRITERS[kind](tmp_path / "a"))
    assert sequence.camera == PinholeCamera(*F, W, H)
    np.testing.assert_allclose(sequence.require_truth().positions_xyz[:, 0], 0.5 * np.arange(N))
    assert [path.name for path in sequence.image_paths] == [f"{i:02d}.png" for i in range(N)]
    for i in range(N):
        image = sequence.image(i)
        np.testing.assert_allclose(centres(image, GRID), GRID, atol=0.05)


def test_pictures_are_undistorted_once(tmp_path, cache):
    write_colmap(tmp_path / "a")
    first = read_recording(tmp_path / "a")
    stamps = {path: path.stat().st_mtime_ns for path in first.image_paths}
    assert all(path.is_relative_to(cache) for path in stamps)
    again = read_recording(tmp_path / "a", require_poses=False)
    assert {path: path.stat().st_mtime_ns for path in again.image_paths} == stamps
    damaged = first.image_paths[1]
    damaged.write_bytes(damaged.read_bytes()[:-20])
    np.testing.assert_allclose(centres(read_recording(tmp_path / "a").image(1), GRID), GRID, atol=0.05)
    # another lens makes other pictures, and so does another picture
    (tmp_path / "a" / "sparse" / "0" / "cameras.txt").write_text(
        f"1 OPENCV_FISHEYE {W} {H} {' '.join(map(str, F))} 0 0 0 0"
    )
    assert not set(stamps) & set(read_recording(tmp_path / "a").image_paths)


def test_a_stated_size_scales_the_lens(tmp_path):
    twice = [2 * v for v in FROM_CORNER]
    sequence = read_recording(write_colmap(tmp_path / "a", (*twice, *K), (2 * W, 2 * H)))
    assert sequence.camera == PinholeCamera(*F, W, H)
    np.testing.assert_allclose(centres(sequence.image(0), GRID), GRID, atol=0.05)


def test_what_a_pinhole_camera_cannot_show_is_cut_off_and_told(tmp_path):
    """A lens of 190 degrees without distortion: r = f t."""
    f = (W / 2) / np.radians(95)
    with pytest.warns(DatasetWarning, match=r"keeps 118 of 190 degrees across; the rest is cut off"):
        sequence = read_recording(write_colmap(tmp_path / "a", (f, f, W / 2 + 0.5, H / 2 + 0.5, 0, 0, 0, 0)))
    assert any(what == "fisheye images are undistorted" for what, _ in sequence.notes)
    assert sequence.image(0)[:, :2].any()  # nothing black at its sides


BAD = {
    "k1 is NaN": (float("nan"), 0, 0, 0),
    "k4 is infinite": (0, 0, 0, float("inf")),
    "k2 is 1e9": (0, 1e9, 0, 0),
    "k1 is 1e300": (1e300, 0, 0, 0),
    "the image folds": (-0.9, 0, 0, 0),
}


@pytest.mark.parametrize("what", BAD)
def test_coefficients_of_no_lens_are_refused(tmp_path, what):
    lens = BAD[what]
    write_colmap(tmp_path / "a", (*F, *lens))
    write_nerf(tmp_path / "b", dict(zip(("k1", "k2", "k3", "k4"), lens, strict=True)))
    for name, file in (("a", r"cameras\.txt, camera 1"), ("b", r"transforms\.json")):
        with pytest.raises(DatasetError, match=file):
            read_recording(tmp_path / name)
