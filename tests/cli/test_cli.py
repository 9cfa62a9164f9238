import json
import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from conformodal.cli.main import app
from conformodal.odometry import read_region_records
from conformodal.poses import read_tum


def invoke(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def results(small_world, tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    arguments = ["run", small_world.model, small_world.folder, "--out", out, "--part", "test"]
    result = invoke(*arguments, "--cache", small_world.cache)
    assert result.exit_code == 0, result.output
    assert result.output.splitlines()[-1] == f"results: {out.resolve()}"
    return out


def test_help_of_every_verb_explains_every_option():
    for verb in ("demo", "train", "run", "evaluate"):
        result = invoke(verb, "--help")
        assert result.exit_code == 0
        assert "--out" in result.output or "OUT" in result.output
    assert invoke("--version").output.strip()[0].isdigit()


def test_run_writes_everything(results):
    metrics = json.loads((results / "metrics.json").read_text())
    assert {"provenance", "configuration", "seed", "split", "errors", "coverage"} <= metrics.keys()
    assert metrics["provenance"]["packages"]["torch"].startswith("2.13")
    assert metrics["split"] == "interleaved"
    assert metrics["n_answered"] == len(read_tum(results / "trajectory.tum"))
    assert set(metrics["errors"]) == {
        "smoothed",
        "viterbi",
        "greedy",
        "softmax_mean",
        "classical",
        "classical_smoothed",
    }
    assert "exchangeable" in metrics["coverage"]["assumption"]
    records = read_region_records(results / "regions.jsonl")
    assert len(records) == metrics["n_answered"]
    for record in records:
        for parts in record["intervals"].values():
            flat = np.ravel(parts)
            assert (np.diff(flat) > 0).all()  # sorted and disjoint


def test_the_page_is_self_contained(results):
    page = (results / "report.html").read_text()
    assert page.count("<svg") == 3
    assert "data:image/png;base64," in page
    for outside in ('src="http', 'href="http', "<script", "<link"):
        assert outside not in page.replace('xlink:href="#', "")


def test_evaluate_agrees_with_run(results, small_world):
    result = invoke("evaluate", results, "--truth", small_world.folder)
    assert result.exit_code == 0, result.output
    ran = json.loads((results / "metrics.json").read_text())
    evaluated = json.loads((results / "evaluation" / "metrics.json").read_text())
    for method, row in ran["errors"].items():
        assert evaluated["errors"][method] == pytest.approx(row, rel=1e-4)
    assert evaluated["coverage"]["joint_coverage"] == pytest.approx(ran["coverage"]["joint_coverage"])
    again = invoke("evaluate", results, "--truth", results / "truth.tum")
    assert again.exit_code == 0, again.output


def test_run_without_poses(small_world, tmp_path):
    shutil.copytree(small_world.folder, tmp_path / "unposed")
    for path in (tmp_path / "unposed").rglob("*.pose.txt"):
        path.unlink()
    for path in sorted((tmp_path / "unposed").rglob("*.png"))[40:]:
        path.unlink()
    result = invoke(
        "run", small_world.model, tmp_path / "unposed", "--out", tmp_path / "out", "--cache", small_world.cache
    )
    assert result.exit_code == 0, result.output
    assert "errors" not in json.loads((tmp_path / "out" / "metrics.json").read_text())
    other = invoke("run", small_world.model, tmp_path / "unposed", "--out", tmp_path / "out", "--part", "test")
    assert other.exit_code == 2
    assert "not the data set" in other.output


def test_bad_input_is_one_kind_line(small_world, tmp_path, results):
    cases = [
        (["train", tmp_path / "absent", "--out", tmp_path / "m"], "no such folder"),
        (["train", small_world.folder, "--out", tmp_path / "m", "--alpha", "90"], "did you mean 0.1"),
        (["train", small_world.folder, "--out", tmp_path / "m", "--joint", "all"], "joint must be"),
        (["train", small_world.folder, "--out", tmp_path / "m", "--score", "best"], "score must be"),
        (["run", tmp_path, small_world.folder, "--out", tmp_path / "o"], "no saved model"),
        (["run", small_world.model, tmp_path, "--out", tmp_path / "o"], "holds no frame"),
        (["run", small_world.model, small_world.folder, "--out", tmp_path / "o", "--alpha", "0"], "alpha"),
        (["evaluate", tmp_path, "--truth", small_world.folder], "metrics.json"),
        (["evaluate", results, "--truth", tmp_path / "absent.tum"], "absent.tum"),
    ]
    for arguments, message in cases:
        result = invoke(*arguments, *(["--cache", small_world.cache] if arguments[0] in ("train", "run") else []))
        assert result.exit_code == 2, (arguments, result.output)
        assert message in result.output.replace("\n", " ")
        assert "Traceback" not in result.output
    assert not (tmp_path / "m").exists()


def test_a_split_in_blocks_promises_nothing(small_world, tmp_path):
    arguments = ["train", small_world.folder, "--out", tmp_path / "m", "--split", "blocks", "--epochs", "2"]
    assert invoke(*arguments, "--cache", small_world.cache).exit_code == 0
    result = invoke(
        "run",
        tmp_path / "m",
        small_world.folder,
        "--out",
        tmp_path / "o",
        "--part",
        "test",
        "--cache",
        small_world.cache,
    )
    assert result.exit_code == 0, result.output
    coverage = json.loads((tmp_path / "o" / "metrics.json").read_text())["coverage"]
    assert "no guarantee" in coverage["assumption"]
    assert "band_99" not in coverage["targets"]["x"]
