"""Code on the pages runs and prints what they say; commands on all pages have verbs and options that exist.

`<!-- given: NAME -->` before a block says what it takes as given. A `text` block after it is what it prints; numbers
may differ a little between versions, and those of a small trained model may be any.
"""

import contextlib
import io
import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sklearn.ensemble import RandomForestClassifier
from typer.main import get_command

from conformodal.cli.main import app
from conformodal.conformal import QuantileBins
from tests.helpers import run_ok

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
HOW_TO = [ROOT / "README.md", *sorted((DOCS / "howto").glob("*.md")), DOCS / "guarantees.md", DOCS / "robots.md"]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted(DOCS.rglob("*.md"))]
BLOCK = re.compile(r"(?:<!-- given: (\w+) -->\n)?```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def arm(rng, n):
    """Elbow angle in degrees given the reach in metres: up or down."""
    reach = rng.uniform(0.4, 1.9, n)
    elbow = np.degrees(np.arccos(reach**2 / 2 - 1))
    return reach[:, None], rng.choice([-1, 1], n) * elbow + rng.normal(0, 4, n)


def table():
    rng = np.random.default_rng(0)
    (X, y), (X_new, y_new) = arm(rng, 3000), arm(rng, 1000)
    return {"X": X, "y": y, "X_new": X_new, "y_new": y_new}


def probabilities():
    """A classifier's, of calibration and new samples."""
    rng = np.random.default_rng(0)
    (X, y), (X_cal, y_cal), (X_new, y_new) = (arm(rng, n) for n in (2000, 1000, 1000))
    bins = QuantileBins(30, margin=0.1).fit(y)
    forest = RandomForestClassifier(min_samples_leaf=20, random_state=0).fit(X, bins.encode(y)[:, 0])
    near = [np.where(table[:, 0] < 1.15, "near", "far") for table in (X_cal, X_new)]
    return {
        "bins": bins,
        "proba_cal": forest.predict_proba(X_cal),
        "proba": forest.predict_proba(X_new),
        "y_cal": y_cal,
        "y_new": y_new,
        "groups_cal": near[0],
        "groups": near[1],
        "conditions_cal": np.column_stack((X_cal < 1.15, X_cal > 0.8)),
        "conditions": np.column_stack((X_new < 1.15, X_new > 0.8)),
        "weights_cal": X_cal[:, 0],
        "weights": X_new[:, 0],
        "person_cal": np.repeat(np.arange(50), 20),
    }


def poses():
    times_s = np.arange(5.0)
    quats = np.tile([1.0, 0, 0, 0], (5, 1))
    return {"times_s": times_s, "positions_xyz": np.zeros((5, 3)), "orientations_quat_wxyz": quats}


GIVEN = {"nothing": dict, "table": table, "probabilities": probabilities, "poses": poses}


def snippets(taken):
    blocks = [(page.stem, block) for page in HOW_TO for block in BLOCK.findall(page.read_text(encoding="utf-8"))]
    return [pytest.param(*block, id=f"{page}-{k}") for k, (page, block) in enumerate(blocks) if taken(block[0])]


def check(code, names, expected, *, numbers=True):
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(code, names)
    if not expected:
        return
    text = printed.getvalue()
    assert NUMBER.sub("#", text) == NUMBER.sub("#", expected)
    for a, b in zip(NUMBER.findall(text), NUMBER.findall(expected), strict=True):
        assert not numbers or float(a) == pytest.approx(float(b), rel=0.2, abs=3 if "." not in b else 0.03)


@pytest.mark.parametrize(("given", "code", "expected"), snippets(lambda given: given not in ("camera", "cluster")))
def test_a_snippet_runs_and_prints_what_the_page_says(given, code, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert given in GIVEN, "say what the block takes as given"
    for package in re.findall(r"^from (quantile_forest|ngboost) ", code, re.MULTILINE):
        pytest.importorskip(package)
    check(code, GIVEN[given](), expected)


def test_the_tutorial_runs_from_top_to_bottom():
    blocks = re.findall(r"```(python|text)\n(.*?)```", (DOCS / "tutorial.md").read_text("utf-8"), re.DOTALL)
    code, expected = ("".join(block for kind, block in blocks if kind == which) for which in ("python", "text"))
    names = {}
    check(code, names, expected)
    assert names["figure"].axes


@pytest.fixture(scope="module")
def in_world(small_world, tmp_path_factory):
    """A folder in which the names that the pages use are: model, recording, scene, and what a short run has written."""
    folder = tmp_path_factory.mktemp("world")
    for name, target in {
        "model": small_world.model,
        "recording": small_world.folder,
        "scene": small_world.folder,
    }.items():
        (folder / name).symlink_to(target, target_is_directory=True)
    arguments = ["run", folder / "model", folder / "recording", "--out", folder / "out", "--limit", 20]
    run_ok(*arguments, *(["--save", folder / "out.mcap"] if find_spec("rosbags") else []))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("given", "code", "expected"), snippets(lambda given: given == "camera"))
def test_a_snippet_runs_on_a_small_world(given, code, expected, in_world, monkeypatch):
    monkeypatch.chdir(in_world)
    check(code, {}, expected, numbers=False)


@pytest.mark.slow
def test_ray_and_dask_write_the_regions_that_one_process_has(tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    pytest.importorskip("dask")
    ray = pytest.importorskip("ray")
    ray.init(address="local")
    request.addfinalizer(ray.shutdown)
    names = table()
    assert [block.id.rpartition("-")[0] for block in snippets(lambda given: given == "cluster")] == ["table-files"]
    for _, code, expected in BLOCK.findall((DOCS / "howto" / "table-files.md").read_text("utf-8")):
        check(code, names, expected)
    regions, by_ray = names["regions"], pd.read_parquet("by-ray").sort_values("id")
    assert by_ray["id"].tolist() == names["table"]["id"].tolist()
    numbers = ["elbow", "elbow_low", "elbow_high"]
    for written in (by_ray, pd.read_parquet("by-dask")):
        np.testing.assert_array_equal(written[numbers], regions[numbers])
        assert written["elbow_intervals"].map(list).tolist() == regions["elbow_intervals"].map(list).tolist()


# ---- commands


def verbs():
    """Every verb's command, by its words."""
    group = get_command(app)
    for name in group.list_commands(None):
        command = group.get_command(None, name).loaded()
        if hasattr(command, "commands"):
            yield from (((name, inner), each) for inner, each in command.commands.items())
            if "fit" in command.commands:  # the default
                yield (name,), command.commands["fit"]
        else:
            yield (name,), command


VERBS = dict(verbs())


def commands_of(markdown):
    """Words of the commands in blocks, and of those in the text that have an option."""
    prose = re.sub(r"^```.*?^```", "", markdown, flags=re.DOTALL | re.MULTILINE)
    for block in re.findall(r"^```(?:sh|bash)?\n(.*?)^```", markdown, re.DOTALL | re.MULTILINE):
        for line in block.splitlines():
            if line.startswith("conformodal "):
                yield shlex.split(line, comments=True)[1:]
    for code in re.findall(r"`([^`]+)`", prose):
        words = code.removeprefix("conformodal ").split()
        if any(word.startswith("--") for word in words[1:]) and words[0] in {name[0] for name in VERBS}:
            yield words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_on_a_page_have_verbs_and_options_that_exist(page):
    for words in commands_of(page.read_text(encoding="utf-8")):
        n = next((n for n in (2, 1) if tuple(words[:n]) in VERBS), 0)
        assert n or words[0] == "VERB", f"no such verb: {' '.join(words)}"
        if not n:
            continue
        command, rest = VERBS[tuple(words[:n])], words[n:]
        options = {option for param in command.params for option in param.opts} | {"--help"}
        assert {word.split("=")[0] for word in rest if word.startswith("--")} <= options, " ".join(words)
