"""Whatever moment a command is killed in, or the disk is full: the earlier result is whole, or the new one is."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from sklearn.tree import DecisionTreeClassifier

from conformodal.cli import extend, run, train
from conformodal.conformal import ConformalRegressor
from conformodal.core.files import _HOST, PART, write_whole
from conformodal.pipeline.model import JournalEntry
from conformodal.pipeline.results import METRICS, ResultsError, lock_output, read_run
from conformodal.pipeline.store import load_model, model_digest, save_model
from tests.helpers import contents, fill, invoke, run_ok
from tests.interruptions import HOW, READ_ONLY, each_step, interrupted
from tests.small_model import image, small_model

LOG = "conformodal.log"
REFUSED = 4  # exit code of what the system refuses


@dataclass
class SimpleRecording:
    """Stands for a recording where its frames are not looked at."""

    name: str = "made up"


@dataclass
class TrainedOn:
    """Stands for training data of it."""

    sequence: SimpleRecording = field(default_factory=SimpleRecording)
    cache: None = None


def models():
    """A small model, and another one."""
    old = small_model()
    rules = replace(old.rules, known_p=old.rules.known_p[::-1].copy())
    return old, replace(old, rules=rules, configuration={**old.configuration, "data": "others"})


def one_line(result, folder):
    """A refusal in one line that names a file of a folder, or the folder."""
    errors = [line for line in result.stderr.splitlines() if "error: " in line]
    assert "Traceback" not in result.output
    assert len(errors) == 1
    assert str(folder) in errors[0]
    assert PART not in errors[0]
    return errors[0]


def results_in(folder):
    """Without the log, and the lock, which this process has not let go of where it was 'killed'."""
    return {name: content for name, content in contents(folder).items() if name not in (LOG, ".lock")}


def command(arguments, folder, how, step):
    """Run a command until it is interrupted; a full disk must be told in one line."""
    with interrupted(folder, how, step) as broken:
        result = invoke(*arguments)
        if result.exit_code == 0:
            return broken.happened  # where what could not be written does not matter, as of a log
        broken.happened = True
        assert result.exit_code in (2, REFUSED), result.output
        assert one_line(result, folder)
    return broken.happened


@pytest.mark.parametrize("how", HOW)
def test_a_model_is_replaced_whole_or_not_at_all(tmp_path, how):
    old, new = models()
    save_model(new, tmp_path / "new")
    after, digest = contents(tmp_path / "new"), model_digest(tmp_path / "new")
    seen = set()
    for step in each_step():
        folder = tmp_path / str(step)
        save_model(old, folder)
        before = model_digest(folder)
        with interrupted(folder, how, step) as broken, lock_output(folder, "train"):
            save_model(new, folder)
        load_model(folder)
        found = model_digest(folder)
        assert found in (before, digest)
        seen.add(found)
        with lock_output(folder, "train"):
            save_model(new, folder)
        assert contents(folder) == after
        if not broken.happened:
            break
    assert seen == {before, digest}
    assert step > 5


def test_metrics_of_an_earlier_model_are_not_shown(tmp_path):
    old, new = models()
    save_model(old, tmp_path)
    record = {"command": "train", "model": model_digest(tmp_path), "verdict": ["of the old one"]}
    write_whole(tmp_path / METRICS, json.dumps(record))
    assert "of the old one" in run_ok("info", tmp_path).output
    save_model(new, tmp_path)
    assert "of the old one" not in run_ok("info", tmp_path).output


@pytest.fixture
def images(tmp_path):
    """Images that the small model's camera has taken."""
    folder = tmp_path / "images"
    fill(folder, {"frame-rate.txt": "10"})
    for k in range(3):
        Image.fromarray(np.roll(image(), k, axis=1)).save(folder / f"frame-{k}.png")
    return folder


def n_records(folder):
    """The number of records of a run; why it is refused, where it is."""
    try:
        return len(read_run(folder).records)
    except ResultsError as exc:
        return str(exc)


@pytest.mark.slow
@pytest.mark.parametrize("how", HOW)
def test_a_run_replaces_an_earlier_one_or_leaves_it(tmp_path, monkeypatch, images, how):
    """A run that is killed in the moment in which it replaces files is refused, and never passes for one of the two."""
    model, limit = tmp_path / "m", ["--limit", 2]
    save_model(small_model(), model)
    loaded = load_model(model)
    monkeypatch.setattr(run, "load_model", lambda _: loaded)
    run_ok("run", model, images, "--out", tmp_path / "before", *limit)
    seen = set()
    for step in each_step():
        out = shutil.copytree(tmp_path / "before", tmp_path / str(step))
        broken = command(["run", model, images, "--out", out], out, how, step)
        n = n_records(out)
        assert n in (2, 3) or (how == "killed" and "Run it again" in n)
        seen.add(n if n in (2, 3) else "refused")
        if how != "killed" and n == 2:  # the earlier run, whose results stay whole
            assert {k: v for k, v in results_in(out).items() if ".part" not in k} == results_in(tmp_path / "before")
        if not broken:
            break
        if step % 7 == 0:
            run_ok("run", model, images, "--out", out)
            assert len(read_run(out).records) == 3
            assert results_in(out).keys() == results_in(tmp_path / "before").keys()
    assert seen == {2, 3} | ({"refused"} if how == "killed" else set())


def with_journal(model):
    """A model that a recording has extended."""
    entry = JournalEntry("new", "2026-01-01", 3, 0.9, 1.0, None, None, 1.0, 0.1, 20, 1)
    return replace(model, journal=(entry,))


def extending(tmp_path, monkeypatch, old, new):
    """The arguments of an extension that makes `new` of `old`, whatever the recording, up to the output folder."""

    def extended(*_, progress, **__):
        progress("features", 1, 1)
        return new

    (tmp_path / "new").mkdir()
    monkeypatch.setattr(extend, "open_recording", lambda *_, **__: SimpleRecording())
    monkeypatch.setattr(extend, "check_extension", lambda *_: None)
    monkeypatch.setattr(extend, "load_model", lambda _: old)
    monkeypatch.setattr(extend, "extend_model", extended)
    return ["extend", tmp_path / "m", tmp_path / "new", "--cache", tmp_path / "cache", "--out"]


def training(tmp_path, monkeypatch, new):
    """The arguments of a training that makes `new`, whatever the data, up to the output folder."""

    def trained(*_, progress, **__):
        progress("training", 1, 1)
        return new

    (tmp_path / "data").mkdir()
    monkeypatch.setattr(train, "open_sequences", lambda *_, **__: SimpleRecording())
    monkeypatch.setattr(train, "prepare_training_data", lambda *_: TrainedOn())
    monkeypatch.setattr(train, "train_model", trained)
    return ["train", tmp_path / "data", "--method", "paper", "--cache", tmp_path / "cache", "--out"]


@pytest.mark.parametrize("how", HOW)
def test_an_extension_is_whole_or_not_there(tmp_path, monkeypatch, how):
    old, new = small_model(), with_journal(small_model())
    save_model(old, tmp_path / "m")
    before, seen = contents(tmp_path / "m"), set()
    arguments = extending(tmp_path, monkeypatch, old, new)
    for step in each_step():
        out = tmp_path / str(step)
        broken = command([*arguments, out], out, how, step)
        there = (out / "model.json").exists()
        seen.add(there)
        if there:
            assert len(load_model(out).journal) == 1
        else:
            run_ok(*arguments, out)
            assert results_in(out).keys() == {*before, METRICS}
        if not broken:
            break
    assert seen == {True, False}
    assert contents(tmp_path / "m") == before


@pytest.mark.parametrize("how", HOW)
def test_a_training_replaces_a_model_or_leaves_it(tmp_path, monkeypatch, how):
    old, new = models()
    save_model(new, tmp_path / "new")
    digest, seen = model_digest(tmp_path / "new"), set()
    arguments = training(tmp_path, monkeypatch, new)
    for step in each_step():
        out = tmp_path / str(step)
        save_model(old, out)
        write_whole(out / METRICS, json.dumps({"command": "train", "model": model_digest(out)}))
        before = model_digest(out)
        broken = command([*arguments, out], out, how, step)
        load_model(out)
        seen.add(model_digest(out))
        run_ok(*arguments, out)
        assert results_in(out).keys() == {*contents(tmp_path / "new"), METRICS}
        assert json.loads((out / METRICS).read_text())["model"] == digest
        if not broken:
            break
    assert seen == {before, digest}


@pytest.fixture(scope="module")
def regressors():
    """Two regressors of a table, and new rows of it."""
    rng = np.random.default_rng(0)
    rows = pd.DataFrame({"x": rng.random(80)})
    y = rows["x"] + rng.normal(0, 0.1, 80)
    trees = (ConformalRegressor(DecisionTreeClassifier(max_depth=depth, random_state=0)) for depth in (1, 3))
    return *(reg.fit(rows, y.rename("y")) for reg in trees), rows


@pytest.mark.parametrize("how", HOW)
def test_a_saved_regressor_is_replaced_whole_or_not_at_all(tmp_path, regressors, how):
    old, new, rows = regressors
    assert (old.predict(rows) != new.predict(rows)).any()
    old.save(tmp_path / "old.skops")
    before, seen = (tmp_path / "old.skops").read_bytes(), set()
    for step in each_step():
        path = tmp_path / str(step) / "y.skops"
        fill(path.parent, {path.name: before})
        with interrupted(path.parent, how, step) as broken:
            new.save(path)
        replaced = path.read_bytes() != before
        seen.add(replaced)
        if replaced:
            np.testing.assert_array_equal(ConformalRegressor.load(path).predict(rows), new.predict(rows))
        if not broken.happened:
            break
    assert seen == {True, False}


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("how", HOW)
def test_regions_of_a_table_are_replaced_whole_or_not_at_all(tmp_path, regressors, how, suffix):
    reg, _, rows = regressors
    reg.save(tmp_path / "y.skops")
    rows.to_csv(tmp_path / "new.csv", index=False)
    arguments = ["table", "predict", tmp_path / "y.skops", tmp_path / "new.csv", "--out"]
    run_ok(*arguments, tmp_path / f"whole{suffix}")
    whole, seen = (tmp_path / f"whole{suffix}").read_bytes(), set()
    for step in each_step():
        out = tmp_path / str(step) / f"sets{suffix}"
        fill(out.parent, {out.name: "earlier"})
        broken = command([*arguments, out], out.parent, how, step)
        assert out.read_bytes() in (b"earlier", whole)
        seen.add(out.read_bytes())
        if not broken:
            break
    assert seen == {b"earlier", whole}


def test_the_next_save_removes_files_of_a_killed_process(tmp_path, regressors):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    left = tmp_path / f".y.skops.{_HOST}.{ended.pid}-1{PART}"
    others = [tmp_path / f".y.skops.{_HOST}.{os.getpid()}-1{PART}", tmp_path / f".z.skops.{ended.pid}-1{PART}"]
    for path in (left, *others):
        path.write_text("half a file")
    regressors[0].save(tmp_path / "y.skops")
    assert not left.exists()
    assert all(path.exists() for path in others)


@pytest.mark.parametrize("named", ["out", "out/new"])
@pytest.mark.parametrize(
    "command", ["train", "run", "extend", "table fit --model", "table fit --plot", "table predict"]
)
def test_an_unwritable_output_is_refused_before_the_work(tmp_path, monkeypatch, images, regressors, command, named):
    out, rows = tmp_path / named, tmp_path / "rows.csv"
    (tmp_path / "out").mkdir()
    save_model(small_model(), tmp_path / "m")
    regressors[0].save(tmp_path / "y.skops")
    regressors[2].assign(y=1.0).to_csv(rows, index=False)
    fit = ["table", "fit", rows, "--target", "y"]
    arguments = {
        "train": lambda: [*training(tmp_path, monkeypatch, None), out],
        "run": lambda: ["run", tmp_path / "m", images, "--out", out],
        "extend": lambda: [*extending(tmp_path, monkeypatch, small_model(), None), out],
        "table fit --model": lambda: [*fit, "--model", out / "y.skops"],
        "table fit --plot": lambda: [*fit, "--plot", out / "y.svg"],
        "table predict": lambda: ["table", "predict", tmp_path / "y.skops", rows, "--out", out / "sets.csv"],
    }[command]()
    for module in (run, extend):
        monkeypatch.setattr(module, "load_model", lambda _: pytest.fail("worked before the folder was looked at"))
    monkeypatch.setattr(ConformalRegressor, "load", None)
    monkeypatch.setattr(ConformalRegressor, "fit", None)
    monkeypatch.setattr(train, "open_sequences", None)
    with interrupted(tmp_path / "out", READ_ONLY, 0):
        result = invoke(*arguments)
        assert result.exit_code == 2
        assert "Read-only file system" in one_line(result, out)
    assert not list((tmp_path / "out").iterdir())
