"""The paper's system from the command line: train, run, evaluate."""

import json

import numpy as np
import pytest

from conformodal.io.pose_files import read_tum
from conformodal.pipeline.results import read_region_records, read_trajectories
from tests.helpers import run_ok


@pytest.fixture(scope="module")
def trained(small_world, tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    options = ["--method", "paper", "--epochs", 15, "--alpha", 0.2, "--cache", small_world.cache]
    run_ok("train", small_world.folder, "--out", folder / "model", *options)
    return folder


def test_a_run_answers_with_greedy_and_nothing_of_ours(trained, small_world):
    out = trained / "out"
    run_ok("run", trained / "model", small_world.folder, "--part", "test", "--out", out)
    metrics = json.loads((out / "metrics.json").read_text())
    assert list(metrics["errors"]) == ["greedy"]
    assert metrics["configuration"]["method"] == "paper"
    assert metrics["coverage"]["joint"] == "none"
    assert metrics["coverage"]["joint_band_99"] is None
    assert "For the whole pose there is no exact law" in metrics["coverage"]["assumption"]
    assert metrics["n_localized"] == metrics["n_unknown"] == 0
    assert not list((out / "methods").iterdir())
    assert {r["known_p"] for r in read_region_records(out / "regions.jsonl")} == {None}  # images are not tested
    answer = read_tum(out / "trajectory.tum")
    assert len(answer) == metrics["n_answered"]
    np.testing.assert_array_equal(read_trajectories(out)["greedy"].positions_xyz, answer.positions_xyz)
    assert "<script" in (out / "report.html").read_text()
    checked = run_ok("evaluate", out, "--truth", out / "truth.tum")
    assert "greedy" in checked.output
    assert "smoothed" not in checked.output
