"""The demo by the paper's system, on a small flight."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from conformodal.cli import demo
from conformodal.cli.demo_pages import describe_ratios
from conformodal.cli.main import app
from conformodal.poses import read_tum
from conformodal.quality.corridor_ambiguity import AmbiguityCheck


@pytest.fixture
def out(small_world, tmp_path, monkeypatch):
    """Holds the first half of the small corridor's flight, as if an earlier demo had written it."""
    folder = tmp_path / "out"
    shutil.copytree(small_world.folder, folder / "corridor")
    flight = {"seed": 3, "n_modules": 3, "n_laps": 1}
    (folder / "corridor" / "demo.json").write_text(json.dumps(flight))
    images = sorted((folder / "corridor" / "seq-01").glob("*.color.png"))
    for image in images[len(images) // 2 :]:
        image.unlink()
        image.with_name(image.name.replace("color.png", "pose.txt")).unlink()
    (folder / "cache").symlink_to(small_world.cache)
    monkeypatch.setattr(demo, "N_MODULES", 3)
    monkeypatch.setattr(demo, "N_LAPS", 1)
    monkeypatch.setattr(demo, "TRAINING", replace(demo.TRAINING, epochs=3))
    return folder


@pytest.mark.slow
def test_the_papers_system_is_trained_and_compared_with_the_classical_regressor(out):
    result = CliRunner().invoke(app, ["demo", "--out", str(out), "--seed", "3", "--method", "paper"])
    assert result.exit_code == 0, result.output
    assert result.output.splitlines()[-1] == f"results: {out.resolve()}"
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["command"] == "demo"
    assert metrics["configuration"]["method"] == "paper"
    assert set(metrics["errors"]) == {"greedy", "classical"}
    assert (metrics["coverage"]["alpha"], metrics["coverage"]["joint"]) == (0.1, "none")
    assert metrics["ambiguity"]["n_places"] > 0
    ratio = metrics["errors"]["classical"]["rmse_m"] / metrics["errors"]["greedy"]["rmse_m"]
    assert f"greedy {ratio:.1f}" in result.output
    answer = read_tum(out / "trajectory.tum")
    assert len(answer) == len(read_tum(out / "methods" / "classical.tum")) == metrics["n_answered"]
    page = (out / "report.html").read_text()
    assert "the paper&#39;s system: its greedy answer" in page
    assert "the paper's greedy answer" in (out / "figures" / "plan.svg").read_text()
    assert "conformal" not in (out / "figures" / "plan.svg").read_text()
    loaded = json.loads((out / "model" / "model.json").read_text())
    assert loaded["configuration"]["method"] == "paper"


def test_the_last_word_says_which_is_the_better_one():
    errors = {name: {"rmse_m": e} for name, e in (("online", 0.25), ("smoothed", 4.0), ("classical", 0.5))}
    said = describe_ratios({"errors": errors, "seconds": 9.6})
    assert "online 2.0, smoothed 0.1 (10 s in all)" in said


def test_the_share_of_places_that_look_the_same_counts_all_frames():
    places, held = [np.zeros((3, 3)), np.zeros((1, 3)), np.empty((0, 3))], [[True, False, True], [True], []]
    found = AmbiguityCheck(places, [np.array(one, dtype=bool) for one in held]).record()
    assert found == {"n_frames": 2, "n_places": 4, "share_held": 0.75}
