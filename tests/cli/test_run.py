"""Running on sources other than a data set: videos, Ctrl-C, sources that break off, the live view."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

from conformodal.datasets import read_sequence
from conformodal.poses import read_tum
from conformodal.running.results.records import read_region_records
from conformodal.running.results.runs import read_trajectories
from tests.helpers import invoke


@pytest.fixture(scope="module")
def video(small_world, tmp_path_factory):
    """The first 40 frames of the small world as a video."""
    sequence = read_sequence(small_world.folder)
    path = tmp_path_factory.mktemp("video") / "flight.avi"
    size = (sequence.camera.width, sequence.camera.height)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, size)
    for i in range(40):
        writer.write(cv2.cvtColor(sequence.image(i), cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def test_a_video_is_run_on(small_world, video, tmp_path):
    result = invoke("run", small_world.model, video, "--out", tmp_path, "--limit", 25)
    assert result.exit_code == 0, result.output
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["n_answered"] == 25
    assert "flight.avi: video, 40 frames" in result.output
    assert "errors" not in metrics
    assert len(read_trajectories(tmp_path)["smoothed"]) == 25
    assert (tmp_path / "report.html").is_file()


def test_a_truncated_video_keeps_what_came_before(small_world, video, tmp_path):
    cut = tmp_path / "cut.avi"
    cut.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    result = invoke("run", small_world.model, cut, "--out", tmp_path / "out")
    assert result.exit_code == 3
    assert "the file was cut off" in " ".join(result.output.split())
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    n = metrics["n_answered"]
    assert 5 < n < 35
    assert "cut off" in metrics["stopped"]
    for trajectory in read_trajectories(tmp_path / "out").values():
        assert len(trajectory) == n
    assert "Stopped early" in (tmp_path / "out" / "report.html").read_text()


def test_a_source_of_another_size_says_so(small_world, tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (32, 24))
    for _ in range(3):
        writer.write(np.zeros((24, 32, 3), np.uint8))
    writer.release()
    result = invoke("run", small_world.model, tmp_path / "v.avi", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "no frame could be answered" in " ".join(result.output.split())
    assert "(24, 32, 3)" in " ".join(result.output.split())


def test_some_frames_of_a_part_are_not_exchangeable(small_world, tmp_path):
    for limit, guaranteed in ((None, True), (30, False)):
        options = [] if limit is None else ["--limit", limit]
        result = invoke("run", small_world.model, small_world.folder, "--part", "test", "--out", tmp_path, *options)
        assert result.exit_code == 0, result.output
        coverage = json.loads((tmp_path / "metrics.json").read_text())["coverage"]
        assert (coverage["joint_band_99"] is not None) == guaranteed
        assert ("no guarantee" in coverage["assumption"]) != guaranteed


def test_only_a_data_set_has_parts(small_world, video, tmp_path):
    result = invoke("run", small_world.model, video, "--out", tmp_path, "--part", "test")
    assert result.exit_code == 2
    assert "only a data set has a test part" in " ".join(result.output.split())


@pytest.mark.slow
def test_ctrl_c_stops_cleanly_with_all_results(small_world, tmp_path):
    command = [sys.executable, "-m", "conformodal.cli.main", "run", small_world.model, small_world.folder]
    command = [sys.executable, "-c", "from conformodal.cli.main import app; app()", *command[3:]]
    command += ["--out", tmp_path, "--pace", "camera"]
    process = subprocess.Popen(
        [str(c) for c in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )
    regions, end = tmp_path / "regions.jsonl", time.monotonic() + 120
    while time.monotonic() < end and not (regions.is_file() and len(regions.read_text().splitlines()) > 15):
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 130, (output, errors)
    assert "Traceback" not in errors
    assert "stopped early: interrupted" in output
    records = read_region_records(regions)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert 15 < len(records) == metrics["n_answered"] < len(read_sequence(small_world.folder))
    assert all(len(t) == len(records) for t in read_trajectories(tmp_path).values())
    assert "Stopped early: interrupted" in (tmp_path / "report.html").read_text()


@pytest.mark.slow
def test_a_run_is_recorded_for_rerun(small_world, tmp_path):
    rerun = pytest.importorskip("rerun")
    arguments = [small_world.model, small_world.folder, "--part", "test", "--limit", 40]
    result = invoke("run", *arguments, "--out", tmp_path / "out", "--save", tmp_path / "view.rrd")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "view.rrd").stat().st_size > 20_000
    text = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "print", str(tmp_path / "view.rrd"), "-vv"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert rerun.__version__
    entities = ("camera/image", "camera/image/tracks", "world/region", "world/candidates", "world/chosen")
    for entity in (*entities, "world/trajectory", "world/truth", "plots/error_m", "status"):
        assert f"/{entity}" in text, entity


def test_a_live_view_without_rerun_is_named(small_world, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = invoke("run", small_world.model, small_world.folder, "--out", tmp_path, "--save", tmp_path / "v.rrd")
    assert result.exit_code == 2
    assert "pip install 'conformodal[view]'" in " ".join(result.output.split())


def test_frames_without_a_pose_are_answered_and_the_others_are_measured(small_world, tmp_path):
    """Errors and coverage are those of ``evaluate``, which pairs the frames that have a pose by their times."""
    place = tmp_path / "some"
    place.mkdir()
    whole = read_sequence(small_world.folder)
    for name in ("camera-intrinsics.txt", "frame-rate.txt"):
        shutil.copy(next(small_world.folder.rglob(name)), place)
    for i, path in enumerate(whole.image_paths[:50]):
        shutil.copy(path, place)
        if i >= 20 and i % 3:
            shutil.copy(path.with_name(path.name.replace("color.png", "pose.txt")), place)
    n = sum(i >= 20 and bool(i % 3) for i in range(50))
    result = invoke("run", small_world.model, place, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert f"{n} of 50 frames have a true pose" in " ".join(result.output.split())
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["n_answered"], metrics["n_with_truth"]) == (50, n)
    times = read_tum(tmp_path / "out" / "truth.tum").timestamps_s
    np.testing.assert_allclose(times, [i / 10 for i in range(50) if i >= 20 and i % 3], atol=1e-6)
    result = invoke("evaluate", tmp_path / "out", "--truth", place)
    assert result.exit_code == 0, result.output
    evaluated = json.loads((tmp_path / "out" / "evaluation" / "metrics.json").read_text())
    assert evaluated["n_matched"] == n
    for name, row in metrics["errors"].items():
        assert row["rmse_m"] == pytest.approx(evaluated["errors"][name]["rmse_m"], abs=1e-6)
    assert metrics["coverage"]["joint_coverage"] == pytest.approx(evaluated["coverage"]["joint_coverage"])
    # of the first frames, none has a pose
    result = invoke("run", small_world.model, place, "--out", tmp_path / "none", "--limit", 12)
    assert result.exit_code == 0, result.output
    assert "errors" not in json.loads((tmp_path / "none" / "metrics.json").read_text())
