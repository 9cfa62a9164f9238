import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from conformodal.geometry import Trajectory
from conformodal.io import check_recording, read_recording
from conformodal.io.pose_files import write_tum
from conformodal.io.streams.video import open_video
from tests.helpers import invoke, refusal, run_ok


def scene(folder, n=6, lens=True):
    rng = np.random.default_rng(0)
    folder.mkdir()
    for i in range(n):
        Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(folder / f"{5 + 0.1 * i:.6f}.png")
    quats = rng.normal(size=(n, 4))
    truth = Trajectory(5 + 0.1 * np.arange(n), rng.normal(size=(n, 3)), quats)
    write_tum(folder / "poses.tum", truth)
    (folder / "camera-intrinsics.txt").write_text("40 0 32\n0 41 24\n0 0 1\n")
    if lens:
        (folder / "camera-distortion.txt").write_text("-0.1 0.02 0.001 0.002\n")
    return read_recording(folder)


def test_a_video_becomes_a_data_set(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for i in range(8):
        writer.write(np.full((48, 64, 3), 25 * i, np.uint8))
    writer.release()
    (tmp_path / "camera-intrinsics.txt").write_text("40 0 32\n0 41 24\n0 0 1\n")
    poses = Trajectory(0.1 * np.arange(8), np.arange(24.0).reshape(8, 3), np.tile([1.0, 0, 0, 0], (8, 1)))
    write_tum(tmp_path / "poses.tum", poses)
    arguments = ["data", "convert", tmp_path / "v.avi", "--out", tmp_path / "set"]
    assert "no camera is known" in refusal(*arguments)
    run_ok(*arguments, "--poses", tmp_path / "poses.tum", "--camera", tmp_path)
    found = read_recording(tmp_path / "set")
    assert len(found) == 8
    np.testing.assert_allclose(found.truth.positions_xyz, poses.positions_xyz)
    assert [int(found.image(i).mean()) for i in range(8)] == pytest.approx([25 * i for i in range(8)], abs=2)
    assert open_video(tmp_path / "v.avi").n_frames == 8


def test_check_finds_what_is_wrong(tmp_path):
    scene(tmp_path / "a", n=12)
    paths = sorted((tmp_path / "a").glob("*.png"))
    paths[3].write_bytes(paths[2].read_bytes())
    paths[7].write_bytes(b"")
    for path in paths[9:]:
        path.rename(path.with_name(f"{float(path.stem) + 2:.6f}.png"))
    assert "good enough: no, fix this first: " in invoke("data", "check", tmp_path / "a").output
    (tmp_path / "a" / "poses.tum").unlink()
    found = check_recording(read_recording(tmp_path / "a", require_poses=False))
    assert found.n_frames == 12
    assert found.n_poses == 0
    assert found.rate_hz == pytest.approx(10)
    assert found.duration_s == pytest.approx(3.1)
    told = {f.what.split(" ")[0]: (f.count, Path(f.first).name.split(":")[0], f.wrong) for f in found.findings}
    assert told["gap"] == (1, "7.900000.png", False)
    assert told["the"] == (1, "5.300000.png", False)
    assert told["image"] == (1, "5.700000.png", True)
    result = invoke("data", "check", tmp_path / "a", "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "image cannot be read" in result.output
    assert "good enough: not to train on, without poses" in result.output
    record = json.loads((tmp_path / "out" / "metrics.json").read_text())["check"]
    assert len(record["findings"]) == 3


def test_what_is_only_worth_knowing_does_not_fail_a_check(tmp_path):
    scene(tmp_path / "a", n=12, lens=False)
    folder, paths = tmp_path / "a", sorted((tmp_path / "a").glob("*.png"))
    paths[3].write_bytes(paths[2].read_bytes())
    for path in paths[9:]:
        path.rename(path.with_name(f"{float(path.stem) + 2:.6f}.png"))
    for name in ("poses.tum", "camera-intrinsics.txt"):
        (folder / name).unlink()
    frames = [{"file_path": path.name} for path in sorted(folder.glob("*.png"))]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 80, "w": 128, "h": 96, "frames": frames}))
    np.savetxt(folder / "times.txt", [float(frame["file_path"][:-4]) for frame in frames])
    output = run_ok("data", "check", folder).output
    for note in ("gap in time", "the same picture", "intrinsics were scaled"):
        assert f"note: 1 x {note}" in output


def test_check_of_a_sound_data_set_says_so(tmp_path):
    scene(tmp_path / "a")
    result = run_ok("data", "check", tmp_path / "a")
    assert "nothing is wrong" in result.output
    assert "poses: 6, all rigid motions" in result.output
