"""Running on sources other than a data set: videos, Ctrl-C, sources that break off, the live view."""

import json
import re
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

from conformodal.cli import run
from conformodal.io import read_recording
from conformodal.io.pose_files import read_tum
from conformodal.pipeline.store import load_model, save_model
from tests.helpers import refusal, run_ok


def test_some_frames_of_a_part_are_not_exchangeable(small_world, tmp_path):
    for limit, guaranteed in ((None, True), (30, False)):
        options = [] if limit is None else ["--limit", limit]
        run_ok("run", small_world.model, small_world.folder, "--part", "test", "--out", tmp_path, *options)
        coverage = json.loads((tmp_path / "metrics.json").read_text())["coverage"]
        assert (coverage["joint_band_99"] is not None) == guaranteed
        assert ("no guarantee" in coverage["assumption"]) != guaranteed


def test_lengths_in_units_of_the_data_are_never_called_metres(small_world, tmp_path):
    model, out = load_model(small_world.model), tmp_path / "out"
    model.configuration["unit"] = "units"
    model.set_novelty_level(0.3)
    save_model(model, tmp_path / "model")
    ran = run_ok("run", tmp_path / "model", small_world.folder, "--limit", 30, "--out", out)
    assert "its poses are in m, and the model's in units: they are not compared" in " ".join(ran.output.split())
    assert not (out / "truth.tum").exists()
    assert "has lengths in m, and the results in units" in refusal("evaluate", out, "--truth", small_world.folder)
    scaled = run_ok("evaluate", out, "--truth", small_world.folder, "--align", "sim3")
    assert re.search(r"\d m\b|\(m\)", scaled.output)  # it is scaled to the truth
    evaluated = run_ok("evaluate", out, "--truth", out / "trajectory.tum")
    for text in (ran.output, evaluated.output, (out / "report.html").read_text()):
        assert "units" in text
        assert not re.search(r"\d m\b|\(m\)", text)


def test_a_focal_length_of_a_folder_of_images_is_refused(small_world, tmp_path):
    found = refusal("run", small_world.model, small_world.folder, "--focal", 150, "--out", tmp_path / "out")
    assert "--camera and --focal are for videos and devices" in found
    assert "camera-intrinsics.txt" in found


@pytest.mark.slow
def test_a_run_is_recorded_for_rerun(small_world, tmp_path):
    rerun = pytest.importorskip("rerun")
    arguments = [small_world.model, small_world.folder, "--part", "test", "--limit", 40]
    run_ok("run", *arguments, "--out", tmp_path / "out", "--save", tmp_path / "view.rrd")
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
    arguments = ["run", small_world.model, small_world.folder, "--out", tmp_path, "--save", tmp_path / "v.rrd"]
    assert "pip install 'conformodal[view]'" in refusal(*arguments)


def test_a_video_of_another_camera_needs_its_focal_length(small_world, tmp_path):
    sequence, video, out = read_recording(small_world.folder), tmp_path / "phone.avi", tmp_path / "out"
    size = 2 * sequence.camera.width, 2 * sequence.camera.height
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10, size)
    for i in range(len(sequence)):
        writer.write(cv2.resize(sequence.image(i)[:, :, ::-1], size))
    writer.release()
    run = ["run", small_world.model, video, "--limit", 3, "--out", out]
    assert "give --camera or --focal" in refusal(*run)
    assert "no focal length" in refusal(*run, "--focal", "auto")  # images of this size have too few corners
    assert "images of fx = 200" in run_ok(*run, "--focal", 200).output
    np.savetxt(tmp_path / "camera-intrinsics.txt", sequence.camera.matrix * [[2], [2], [1]])
    assert f"images of fx = {2 * sequence.camera.fx:g}" in run_ok(*run, "--camera", tmp_path).output
    assert "no such file" in refusal(*run, "--camera", tmp_path / "none")
    assert "--focal" in refusal("run", small_world.model, small_world.folder, "--focal", 99, "--out", out)


def test_only_frames_with_a_true_pose_are_evaluated(small_world, tmp_path):
    """Errors and coverage are those of ``evaluate``, which pairs the frames that have a pose by their times."""
    place = tmp_path / "some"
    place.mkdir()
    whole = read_recording(small_world.folder)
    for name in ("camera-intrinsics.txt", "frame-rate.txt"):
        shutil.copy(next(small_world.folder.rglob(name)), place)
    for i, path in enumerate(whole.image_paths[:50]):
        shutil.copy(path, place)
        if i >= 20 and i % 3:
            shutil.copy(path.with_name(path.name.replace("color.png", "pose.txt")), place)
    n = sum(i >= 20 and bool(i % 3) for i in range(50))
    result = run_ok("run", small_world.model, place, "--out", tmp_path / "out")
    assert f"{n} of 50 frames have a true pose" in result.output
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["n_answered"], metrics["n_with_truth"]) == (50, n)
    times = read_tum(tmp_path / "out" / "truth.tum").timestamps_s
    np.testing.assert_allclose(times, [i / 10 for i in range(50) if i >= 20 and i % 3], atol=1e-6)
    result = run_ok("evaluate", tmp_path / "out", "--truth", place)
    evaluated = json.loads((tmp_path / "out" / "evaluation" / "metrics.json").read_text())
    assert evaluated["n_matched"] == n
    for name, row in metrics["errors"].items():
        assert row["rmse_m"] == pytest.approx(evaluated["errors"][name]["rmse_m"], abs=1e-6)
    assert metrics["coverage"]["joint_coverage"] == pytest.approx(evaluated["coverage"]["joint_coverage"])
    # of the first frames, none has a pose
    result = run_ok("run", small_world.model, place, "--out", tmp_path / "none", "--limit", 12)
    assert "errors" not in json.loads((tmp_path / "none" / "metrics.json").read_text())


class Recorder:
    """Stands in for a recording."""

    def __init__(self, *arguments, **options):
        self.open = True
        opened.append(self)

    def log(self, *frame):
        pass

    def close(self):
        self.open = False

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()


opened: list[Recorder] = []


@pytest.fixture
def recorders(monkeypatch):
    opened.clear()
    monkeypatch.setattr("conformodal.ros.bag.BagWriter", Recorder)
    monkeypatch.setattr("conformodal.report.live.LiveView", Recorder)


class NoScreen(Recorder):
    def __init__(self, *arguments, **options):
        raise OSError("no screen")


class Broken(Recorder):
    def close(self):
        raise OSError("gone")


@pytest.mark.usefixtures("recorders")
@pytest.mark.parametrize(("view", "still_open"), [(NoScreen, []), (Broken, [True, False])])
def test_a_view_that_fails_leaves_no_recording_open(monkeypatch, tmp_path, view, still_open):
    monkeypatch.setattr("conformodal.report.live.LiveView", view)
    sinks = run.frame_sinks("a", 0.1, view=True, save=tmp_path / "a.mcap", images=False)
    with pytest.raises(OSError, match=r"^(no screen|gone)$"), sinks:
        pass
    assert [recorder.open for recorder in opened] == still_open


def test_images_alone_are_answered_with_the_camera_of_the_model(small_world, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for path in sorted((small_world.folder / "seq-01").glob("*.png"))[:6]:
        (folder / path.name.replace("frame-", "")).write_bytes(path.read_bytes())
    found = run_ok("run", small_world.model, folder, "--out", tmp_path / "out")
    assert "no calibration; the model's camera is assumed. camera-intrinsics.txt in it names" in " ".join(
        found.output.split()
    )
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["n_answered"] == 6


def test_images_alone_of_another_size_are_refused(small_world, tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        cv2.imwrite(str(folder / f"{i}.png"), np.zeros((48, 64, 3), np.uint8))
    found = refusal("run", small_world.model, folder, "--out", tmp_path / "out")
    assert "images have 64x48 pixels, and the camera has 160x120" in found
