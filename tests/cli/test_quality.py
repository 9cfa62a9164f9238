"""``data check`` and ``train`` say whether a recording is good enough."""

import json
import shutil

import numpy as np
import pytest

from conformodal.datasets import read_sevenscenes
from conformodal.model.store import load_model
from tests.helpers import invoke


def quality_of(folder):
    return json.loads((folder / "metrics.json").read_text()).get("quality")


@pytest.mark.slow
def test_a_check_with_a_model_looks_at_frames_that_no_source_has_seen(small_world, tmp_path):
    out = tmp_path / "out"
    options = ["--model", small_world.model, "--cache", small_world.cache, "--out", out]
    for _ in range(2):  # its own folder is written over
        result = invoke("data", "check", small_world.folder, *options)
        assert result.exit_code == 0, result.output
    found, model = quality_of(out), load_model(small_world.model)
    assert found["ambiguity"]["n_looked_at"] == min(400, found["n_frames"] - len(model.localizer.frames))
    assert found["n_known"] == len(model.localizer.frames)
    assert {row["evidence"] for row in found["guarantees"]} == {"global", "unmatched", "landmarks"}
    assert "frames that the model has not seen" in result.output
    page = (out / "report.html").read_text()
    assert "What to record or train on next" in page
    assert "well covered" in page
    assert "well covered" in (out / "figures" / "plan.svg").read_text()


@pytest.mark.slow
def test_training_says_it_too(small_world):
    found = quality_of(small_world.model)
    model = load_model(small_world.model)
    assert found["n_frames"] == len(read_sevenscenes(small_world.folder))
    assert found["ambiguity"]["n_looked_at"] == min(100, found["n_frames"] - len(model.localizer.frames))
    assert len(found["guarantees"]) == 3


@pytest.mark.slow
def test_a_piece_that_is_cut_out_by_hand_is_found(small_world, tmp_path):
    result = invoke("data", "check", small_world.folder, "--out", tmp_path / "whole")
    assert result.exit_code == 0, result.output
    whole = quality_of(tmp_path / "whole")
    assert whole["sparse"] == []
    assert "ambiguity" not in whole
    shutil.copytree(small_world.folder, tmp_path / "cut")
    names = sorted(path.name for path in (tmp_path / "cut" / "seq-01").glob("*.pose.txt"))
    poses = read_sevenscenes(small_world.folder).require_truth()
    first = 20
    away = np.linalg.norm(poses.positions_xyz - poses.positions_xyz[first], axis=1)
    last = first + int(np.argmax(away[first:] > 2.0))  # metres
    for name in names[first + 1 : last]:
        for path in (tmp_path / "cut" / "seq-01").glob(name.replace("pose.txt", "*")):
            path.unlink()
    result = invoke("data", "check", tmp_path / "cut", "--out", tmp_path / "out")
    gaps = quality_of(tmp_path / "out")["fast"]
    assert any(gap["first"] <= first and gap["last"] > first and gap["distance_m"] > 1 for gap in gaps)
    assert "record more views there" in result.output


def test_without_poses_and_model_there_is_nothing_to_say(small_world, tmp_path):
    shutil.copytree(
        small_world.folder / "seq-01", tmp_path / "a" / "seq-01", ignore=shutil.ignore_patterns("*.pose.txt")
    )
    for path in small_world.folder.glob("*.txt"):
        shutil.copy(path, tmp_path / "a")
    result = invoke("data", "check", tmp_path / "a", "--out", tmp_path / "out")
    assert "record next" not in result.output
    assert [path.name for path in (tmp_path / "out").iterdir() if not path.name.startswith(".")] == ["metrics.json"]
    assert quality_of(tmp_path / "out") is None
