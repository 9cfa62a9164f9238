import json
import re
import shutil
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest
import typer

from conformodal.cli.console import Command
from conformodal.cli.main import COMMANDS, app
from conformodal.io import read_recording
from conformodal.io.pose_files import read_tum
from conformodal.pipeline.guarantee import describe_guarantee
from conformodal.pipeline.results import read_region_records
from conformodal.pipeline.store import load_model, save_model
from tests.helpers import invoke, refusal, run_ok


@pytest.fixture(scope="module")
def results(small_world, tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    arguments = ["run", small_world.model, small_world.folder, "--out", out, "--part", "test"]
    result = run_ok(*arguments)
    lines = result.stdout.splitlines()
    assert lines[-2:] == [f"log: {out.resolve() / 'conformodal.log'}", f"results: {out.resolve()}"]
    assert lines[-5:-2] == json.loads((out / "metrics.json").read_text())["verdict"]
    assert "errors, " in (out / "conformodal.log").read_text()  # details are kept, though they are not printed
    return out


def test_help_of_every_verb_explains_every_option():
    group = typer.main.get_command(app)
    verbs = {name: group.get_command(None, name).loaded() for name in group.list_commands(None)}
    assert list(verbs) == list(COMMANDS)
    for group in ("data", "table"):
        verbs |= {f"{group} {name}": verb for name, verb in verbs.pop(group).commands.items()}
    for name, verb in verbs.items():
        shown = invoke(*name.split(), "--help")
        assert shown.exit_code == 0
        assert "<bool>" not in shown.output
        assert isinstance(verb, Command)  # which refuses an option given twice
        for parameter in verb.params:
            record = parameter.get_help_record(typer.Context(verb))
            assert record, f"{name} hides {parameter.name}"
            # typer adds [default: 3] and [required]
            assert re.sub(r"\[[^]]*\]", "", record[1]).strip(), f"{name} does not explain {parameter.name}"
    found = subprocess.run(
        [sys.executable, "-m", "conformodal", "--version"], capture_output=True, text=True, check=True
    )
    assert invoke("--version").output == found.stdout == f"{version('conformodal')}\n"


@pytest.mark.parametrize(
    ("words", "meant"),
    [("tabel", "'table'"), ("data chekc", "'check'"), ("table fti a", "'fit'"), ("train a --split x", "'x' is not")],
)
def test_a_typo_is_reported_with_a_suggestion(words, meant):
    shown = refusal(*words.split())
    assert meant in shown
    assert "Value error" not in shown


def test_run_writes_everything(results):
    metrics = json.loads((results / "metrics.json").read_text())
    assert {"provenance", "configuration", "seed", "split", "errors", "coverage"} <= metrics.keys()
    assert metrics["provenance"]["packages"]["onnxruntime"] == version("onnxruntime")
    assert metrics["split"] == "interleaved"
    assert metrics["n_answered"] == len(read_tum(results / "trajectory.tum"))
    assert list(metrics["errors"]) == ["online", "smoothed", "hindsight"]
    assert {path.stem for path in (results / "methods").iterdir()} == {"hindsight", "online"}
    assert "exchangeable" in metrics["coverage"]["assumption"]
    records = read_region_records(results / "regions.jsonl")
    assert len(records) == metrics["n_answered"]
    for record in records:
        for parts in record["intervals"].values():
            flat = np.ravel(parts)
            assert (np.diff(flat) > 0).all()  # sorted and disjoint


def test_evaluate_agrees_with_run(results, small_world):
    run_ok("evaluate", results, "--truth", small_world.folder)
    ran = json.loads((results / "metrics.json").read_text())
    evaluated = json.loads((results / "evaluation" / "metrics.json").read_text())
    for method, row in ran["errors"].items():
        assert {k: evaluated["errors"][method][k] for k in row} == pytest.approx(row, rel=1e-4)
    for name in ("joint_coverage", "n_bounded", "bounded_coverage", "abstained"):
        assert evaluated["coverage"][name] == pytest.approx(ran["coverage"][name])
    again = run_ok("evaluate", results, "--truth", results / "truth.tum", "--align", "sim3")
    aligned = json.loads((results / "evaluation-sim3" / "metrics.json").read_text())["errors"]["smoothed"]
    before = evaluated["errors"]["smoothed"]
    assert aligned["rmse_m"] < before["rmse_m"]
    assert aligned["rpe_rmse_deg"] == pytest.approx(before["rpe_rmse_deg"], rel=1e-3)  # no alignment changes it
    table = np.genfromtxt(results / "evaluation" / "errors.csv", delimiter=",", names=True)
    assert np.sqrt(np.mean(table["smoothed_m"] ** 2)) == pytest.approx(before["rmse_m"])
    assert "<svg" in (results / "evaluation" / "errors.svg").read_text()
    assert "aligned by sim3" in again.output
    assert "absent.tum" in refusal("evaluate", results, "--truth", results / "absent.tum")
    assert "metrics.json" in refusal("evaluate", small_world.folder, "--truth", small_world.folder)


def test_evaluate_doubts_a_truth_that_is_not_what_it_seems(results, tmp_path):
    rows = np.loadtxt(results / "truth.tum")
    none, order, late, centimetres = (rows.copy() for _ in range(4))
    none[:, 4:] = 0, 0, 0, 1
    order[:, 4:] = np.roll(rows[:, 4:], 1, axis=1)
    late[:, 0] += 3.0
    centimetres[:, 1:4] *= 100
    told = {}
    for name, table in {"none": none, "order": order, "late": late, "centimetres": centimetres}.items():
        np.savetxt(tmp_path / f"{name}.tum", table)
        told[name] = " ".join(run_ok("evaluate", results, "--truth", tmp_path / f"{name}.tum").stdout.split())
        evaluated = json.loads((results / "evaluation" / "metrics.json").read_text())
        assert len(evaluated["truth_doubts"]) >= 1
        assert (evaluated["coverage"]["joint_coverage"] is None) == (name == "none")
        assert ("rmse_deg" in evaluated["errors"]["online"]) == (name != "none")
    assert "its orientations are all the same" in told["none"]
    assert "seem to be in centimetres" in told["centimetres"]
    assert "in the order w x y z" in told["order"]
    ahead = re.search(r"clock seems to be ([\d.]+) s ahead", told["late"])
    assert float(ahead[1]) == pytest.approx(3, abs=0.05)


def test_run_counts_which_frames_show_no_known_place(small_world, tmp_path):
    model = load_model(small_world.model)
    model.set_novelty_level(0.2)
    save_model(model, tmp_path / "model")
    arguments = ["run", tmp_path / "model", small_world.folder, "--part", "test", "--out", tmp_path]
    result = run_ok(*arguments, "--verbose")
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    n, coverage = metrics["n_unknown"], metrics["coverage"]
    assert n > 1
    assert metrics["configuration"]["novelty_level"] == 0.2
    assert coverage["n_bounded"] == round((1 - coverage["abstained"]) * coverage["n_evaluated"])
    held = round(coverage["bounded_coverage"] * coverage["n_bounded"])
    # unbounded regions hold the truth whatever it is
    assert held == round(coverage["joint_coverage"] * coverage["n_evaluated"]) - n
    for said in (" ".join(result.output.split()), (tmp_path / "report.html").read_text()):
        assert f"{n} of {metrics['n_answered']} frames show no known place" in said
    records = read_region_records(tmp_path / "regions.jsonl")
    assert sum(record["evidence"] == "unknown" for record in records) == n


def test_a_split_in_blocks_has_no_coverage_guarantee(small_world, tmp_path):
    arguments = ["train", small_world.folder, "--out", tmp_path / "m", "--split", "blocks", "--epochs", "2"]
    arguments += ["--sources", "head"]  # a map a fold takes minutes
    trained = run_ok(*arguments, "--cache", small_world.cache, "--verbose")
    model = load_model(tmp_path / "m")
    assert 9 <= model.calibration.n_units <= 25  # stretches, not frames
    assert describe_guarantee(model) in " ".join(trained.output.split())
    run_ok("run", tmp_path / "m", small_world.folder, "--out", tmp_path / "o", "--part", "test")
    coverage = json.loads((tmp_path / "o" / "metrics.json").read_text())["coverage"]
    assert coverage["assumption"] == f"{describe_guarantee(model)} Coverage here is an observation."
    assert coverage["joint_band_99"] is None
    assert "band_99" not in coverage["targets"]["x"]


def test_test_frames_with_a_known_picture_are_counted(small_world, tmp_path):
    folder = tmp_path / "flight"
    shutil.copytree(small_world.folder, folder)
    pictures = sorted(folder.rglob("*.color.png"))
    for before, path in zip(pictures[::4], pictures[2::4], strict=False):  # every fourth frame shows an earlier picture
        shutil.copy(before, path)
    out = tmp_path / "model"
    arguments = ["train", folder, "--out", out, "--cache", small_world.cache, "--epochs", "2", "--sources", "head"]
    result = run_ok(*arguments, "--split", "interleaved")
    metrics, model = json.loads((out / "metrics.json").read_text()), load_model(out)
    content = [path.read_bytes() for path in read_recording(folder).image_paths]
    known = {content[i] for i in np.concatenate((model.split.train, model.split.calibration))}
    expected = sum(content[i] in known for i in model.split.test)
    assert metrics["split"]["n_test_same_picture"] == expected > 0
    assert f"{expected} of {len(model.split.test)} test frames show" in result.output.replace("\n", " ")


@pytest.mark.slow
def test_data_check_with_a_model_uses_unseen_frames(small_world, tmp_path):
    out = tmp_path / "out"
    options = ["--model", small_world.model, "--cache", small_world.cache, "--out", out]
    for _ in range(2):  # its own folder is written over
        result = run_ok("data", "check", small_world.folder, *options)
    found = json.loads((out / "metrics.json").read_text())["quality"]
    model = load_model(small_world.model)
    assert found["ambiguity"]["n_looked_at"] == min(400, found["n_frames"] - len(model.localizer.frames))
    assert found["n_known"] == len(model.localizer.frames)
    told = {"unmatched", "landmarks"} | ({"disturbed"} if model.rules.disturbed else set())
    assert {row["evidence"] for row in found["guarantees"]} == told
    assert "frames that the model has not seen" in result.output
    page = (out / "report.html").read_text()
    assert "What to record or train on next" in page
    assert "well covered" in page
    assert "well covered" in (out / "figures" / "plan.svg").read_text()


@pytest.mark.slow
def test_recordings_are_given_as_several_arguments(small_world, tmp_path):
    """One recording trains, another tests; a run answers two, each as a recording of its own."""
    parts = [tmp_path / "one", tmp_path / "two"]
    for part, kept in zip(parts, ("0000[0-5]*", "0001[01]*"), strict=True):  # 60 frames, and 20
        (part / "seq-01").mkdir(parents=True)
        for file in (small_world.folder / "seq-01").glob(f"frame-{kept}"):
            shutil.copy(file, part / "seq-01")
        for name in ("camera-intrinsics.txt", "frame-rate.txt"):
            shutil.copy(small_world.folder / name, part)
    model, options = tmp_path / "model", ["--cache", small_world.cache, "--epochs", "2", "--sources", "head"]
    run_ok("train", parts[0], "--out", model, "--test", parts[1], *options)
    found = load_model(model)
    np.testing.assert_array_equal(found.split.test, np.arange(60, 80))
    assert found.split.kind == "given"
    run_ok("run", model, *parts, "--out", tmp_path / "out")
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["n_answered"] == 80
    assert "errors" in metrics
    refused = invoke("train", *parts, "--out", tmp_path / "other", "--test", parts[1])
    assert refused.exit_code
    assert "is in two of the data sets" in " ".join(refused.output.split())


@pytest.mark.parametrize(
    ("commands", "heavy"),
    [([()], ("torch", "scipy", "sklearn", "cv2", "matplotlib")), ([("train",), ("run",)], ("torch",))],
)
def test_help_imports_nothing_heavy(commands, heavy):
    script = "import sys; from contextlib import suppress; from conformodal.cli.main import app\n"
    script += f"for words in {commands}:\n with suppress(SystemExit): app([*words, '--help'])\n"
    script += f"print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.count("Usage") == len(commands)
    assert done.stdout.splitlines()[-1] == "[]"


def test_info_names_training_data_guarantee_and_size(small_world):
    found = json.loads(invoke("info", small_world.model, "--json").stdout)
    model = load_model(small_world.model)
    assert found["frames"] == {part: len(model.split.part(part)) for part in ("train", "calibration", "test")}
    assert (found["configuration"]["alpha"], found["camera"]["width"]) == (0.2, model.camera.width)
    (weights,) = small_world.model.glob("weights-*")
    assert found["bytes"][weights.name] == weights.stat().st_size
    assert set(found["bounded_regions"]) == {kind.name.lower() for kind in model.rules.by_type}
    assert found["guarantee"] == describe_guarantee(model)
    shown = invoke("info", small_world.model).stdout.splitlines()
    assert shown == found["verdict"] == json.loads((small_world.model / "metrics.json").read_text())["verdict"]
    assert [line.split(":")[0] for line in shown] == ["coverage", "size", "next"]
    assert invoke("info", small_world.model, "--verbose").stdout.splitlines()[:3] == shown
