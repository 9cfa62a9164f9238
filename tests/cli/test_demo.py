"""The demo by the paper's system, on a small flight."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from conformodal.cli import demo
from conformodal.cli.demo_pages import count_places, describe_ratios, true_place_chosen
from conformodal.cli.main import app
from conformodal.model.config import Method
from conformodal.poses import Trajectory, read_tum
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


def test_the_caption_tells_a_choice_of_the_wrong_room_from_one_of_the_right_room():
    def path(*x):
        return Trajectory(np.arange(len(x)) / 10, np.outer(x, [1.0, 0, 0]), np.tile([1.0, 0, 0, 0], (len(x), 1)))

    places = [np.array([[3.0, 0, 0]]), np.array([[3.0, 0, 0]]), np.empty((0, 3))]
    held = [np.array([True]), np.array([False]), np.empty(0, dtype=bool)]
    alike = AmbiguityCheck(places, held)
    truth, chosen = path(0, 0, 0), path(0.1, 2.9, 2.9)
    assert true_place_chosen(chosen, truth, alike).tolist() == [True, False, True]
    run = SimpleNamespace(trajectory=chosen, trajectories={"classical": path(1.5, 1, 0)})
    results = SimpleNamespace(outcome=SimpleNamespace(run=run, truth=truth), alike=alike)
    right, wrong = (count_places(results, i) for i in (0, 1))
    assert "nearest to the true place;" in right
    assert "1.50 m from the nearest" in right
    assert "nearest to a wrong one;" in wrong
    for said in (right, wrong):  # of the run: two frames with such places, one of them held, one chosen rightly
        assert "Of 2 frames" in said
        assert "all of them in 1, and the chosen pose is nearest to the true one in 1." in said


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
    assert f"{ratio:.2f}" in result.output
    answer = read_tum(out / "trajectory.tum")
    assert len(answer) == len(read_tum(out / "methods" / "classical.tum")) == metrics["n_answered"]
    page = (out / "report.html").read_text()
    assert "the paper&#39;s system: its greedy answer" in page
    assert "the paper's greedy answer" in (out / "figures" / "plan.svg").read_text()
    assert "conformal" not in (out / "figures" / "plan.svg").read_text()
    loaded = json.loads((out / "model" / "model.json").read_text())
    assert loaded["configuration"]["method"] == "paper"


def test_the_last_word_says_which_is_the_better_one():
    errors = {name: {"rmse_m": e} for name, e in (("greedy", 2.0), ("classical", 0.5))}
    metrics = {"errors": {**errors, "online": {"rmse_m": 0.25}, "smoothed": {"rmse_m": 0.1}}, "seconds": 9.6}
    said = describe_ratios(Method.PAPER, metrics)
    assert "0.25; below 1 the regressor is the better one" in said
    assert describe_ratios(Method.CONFORMODAL, metrics) == (
        "classical / conformal rmse_m: online 2.0, with hindsight 5.0   (10 s in all)"
    )
