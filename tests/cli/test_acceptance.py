"""The main job, end to end, on the corridor and on real video."""

import json

import numpy as np
import pytest

from conformodal.cli import demo
from conformodal.io import read_recording
from conformodal.io.pose_files import read_tum
from tests.helpers import run_ok

pytestmark = pytest.mark.slow


def inside_band(coverage):
    low, high = coverage["joint_band_99"]
    return low <= coverage["joint_coverage"] <= high


def test_demo(tmp_path):
    found = run_ok("demo", "--out", tmp_path, "--seed", "1")
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    n, errors, coverage, paths = (metrics[key] for key in ("n_answered", "errors", "coverage", "path_coverage"))
    assert errors["classical"]["rmse_m"] >= 3 * errors["smoothed"]["rmse_m"]
    # of one new pass it is an observation; of passes like it, 0.9 on average
    assert coverage["bounded_coverage"] > 0.8
    assert coverage["n_bounded"] > 0.8 * n
    assert metrics["ambiguity"]["n_places"] > 50
    # a place that looks the same has no guarantee of its own, and is in the region only if one of the hypotheses that
    # count is there
    assert metrics["ambiguity"]["share_held"] >= 0.8
    assert 1 < coverage["mean_places"] < 6
    assert paths["online"]["coverage"] > 0.8
    assert paths["online"]["mean_places"] < coverage["mean_places"]  # motion tells rooms apart
    assert paths["n_reliable"] > 0.5 * n
    assert metrics["n_reliable_wrong"] == 0
    [first] = [line for line in found.output.splitlines() if line.startswith("reliable: ")]
    assert first == f"reliable: {paths['n_reliable']} of {n} poses are reliable; 0 of these are over 0.5 m off"
    assert found.output.splitlines()[-1] == f"results: {tmp_path.resolve()}"
    assert metrics["command"] == "demo"
    assert set(errors) == {"online", "smoothed", "hindsight", "classical"}
    assert set(paths) >= {"online", "hindsight"}
    assert len(read_tum(tmp_path / "trajectory.tum")) == len(read_tum(tmp_path / "methods" / "classical.tum")) == n
    passes = read_recording(tmp_path / "corridor" / "passes-seed-1").recording
    assert np.bincount(passes).tolist() == [n] * demo.N_PASSES
    page = (tmp_path / "report.html").read_text()
    assert "of the same view; the regions hold" in page
    assert "classical regressor" in page


def test_redkitchen_interleaved(redkitchen, tmp_path):
    cache = tmp_path / "cache"
    run_ok("train", redkitchen, "--out", tmp_path / "model", "--cache", cache, "--split", "interleaved")
    run_ok("run", tmp_path / "model", redkitchen, "--out", tmp_path / "out", "--part", "test")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["n_answered"] == 200
    assert metrics["errors"]["smoothed"]["rmse_m"] <= 0.020
    assert inside_band(metrics["coverage"])
