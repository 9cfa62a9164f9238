import json
import shutil
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from conformodal.io import SplitKind
from conformodal.pipeline.config import Method
from conformodal.pipeline.results import ResultsError, read_metrics, read_trajectories
from experiments import figures, table1
from experiments.baselines import BASELINES
from experiments.conditions import CALIBRATION_SHARE, rows_of, tasks_of
from experiments.drawing import StoredRun
from experiments.table1 import WhichBaselines
from experiments.tables import METHODS, Tables, page, tidy
from experiments.tasks import ExperimentError
from experiments.worker import rank_correlation

ROWS = rows_of()
OURS = [name for name in METHODS if not name.startswith("paper")]
PAPERS = [name for name in METHODS if name.startswith("paper")]
BOTH = [SplitKind.INTERLEAVED, SplitKind.BLOCKS]


def test_every_row_has_its_training_and_none_is_done_twice():
    tasks = tasks_of(ROWS, BOTH, [0, 1], 100, "digest")
    assert len({t.key for t in tasks}) == len(tasks) == 2 * 2 * 2 * 4
    assert {t.method for t in tasks[:16]} == {Method.PAPER}  # these take minutes
    for row in ROWS:
        matching = [t for t in tasks if (t.used, t.network) == (row.used, row.network) and row.sigma in t.sigmas]
        assert len(matching) == 8
    assert json.loads(json.dumps(tasks[0].settings))["sigmas"] == [0.0, 0.05, 0.1, 0.2]


def test_networks_of_the_hub_have_file_names_of_their_own():
    rows = rows_of(["hf:google/efficientnet-b0", "hf:google/efficientnet-b3", "hf:google/efficientnet-b7"])
    keys = {t.key for t in tasks_of(rows, BOTH, [0], 100, "digest")}
    assert len(keys) == 16
    assert all("/" not in key and ":" not in key for key in keys)
    with pytest.raises(ExperimentError, match="a small, a middle and a large"):
        rows_of(["efficientnet_lite0"])


def made_up_papers(task, error):
    names = ("greedy", "softmax_mean", "plain", "tuned")
    errors = {m: {"rmse_m": error / 2, "rmse_deg": 1.0, "median_m": 0.0, "median_deg": 0.0} for m in names}
    errors["greedy"]["rmse_m"] = error
    region = {"joint_coverage": 0.5, "coverage": 0.9, "length": [0.3] * 7, "intervals": 2.5}
    tested = {"errors": errors, "region": region}
    noise = {f"{s:g}": tested for s in task.sigmas}
    cost = {"greedy": {"train_s": 3.0, "n_parameters": 1_000_000}}
    return {"frames": {"train": 1, "calibration": 1, "test": 1}, "cost": cost, "noise": noise}


def made_up(task):
    """Results in which the conformal error is 0.01 + seed / 1000, and the tuned one three times that.

    The paper's system errs ten times as much as ours, and the regressors on its features half of that.
    """
    ours = 0.01 + task.seed / 1000
    if task.method is Method.PAPER:
        return made_up_papers(task, 10 * ours)
    errors = {m: {"rmse_m": 2 * ours, "rmse_deg": 1.0, "median_m": 0.0, "median_deg": 0.0} for m in OURS}
    errors["smoothed"]["rmse_m"] = ours
    errors["tuned"]["rmse_m"] = 3 * ours
    errors["deep_ensemble"]["rmse_m"] = 1.5 * ours
    region = {
        "joint_coverage": 0.9,
        "coverage": 0.95,
        "length": [0.1] * 7,
        "intervals": 1.5,
        "size_error_rank_correlation": None,
    }
    cost = {"tuned": {"train_s": 5.0, "n_parameters": 10}}
    noise = {f"{s:g}": {"errors": errors, "region": region} for s in task.sigmas}
    return {"frames": {"train": 1, "calibration": 1, "test": 1}, "cost": cost, "noise": noise}


def test_the_table_holds_every_row_with_ratios_seed_by_seed():
    tasks = tasks_of(ROWS, BOTH, [0, 1, 2], 100, "digest")
    records = tidy(ROWS, tasks, [made_up(t) for t in tasks])
    assert len(records) == len(ROWS) * 2 * 3 * len(METHODS)
    tuned = [r for r in records if r["method"] == "tuned"]
    assert {r["train_s"] for r in tuned} == {5.0}
    assert all(r["ratio"] == pytest.approx(1) for r in tuned)
    tables = Tables(ROWS, records)
    for split in ("interleaved", "blocks"):
        errors = tables.errors(split, "rmse_m", 4)
        assert [line[0] for line in errors.lines] == list(METHODS.values())
        assert len({line.count("|") for line in errors.markdown().splitlines()}) == 1
        regions = [dict(zip(tables.regions(split).header, line, strict=True)) for line in tables.regions(split).lines]
        assert len(regions) == 2 * len(ROWS)
        papers, ours = regions[:2]
        assert (papers["one target covered"], papers["whole pose covered"]) == ("0.90 ± 0.00", "0.50 ± 0.00")
        assert (ours["one target covered"], ours["set length"]) == ("0.95 ± 0.00", "0.10 ± 0.00")
        assert ours["size against error"] == ""  # no correlation known
        assert tables.costs(split).lines == [
            [METHODS["paper"], "0.1100 ± 0.0100", "3.0 ± 0.0", "4.0"],
            [METHODS["tuned"], "0.0330 ± 0.0030", "5.0 ± 0.0", "0.0"],
        ]


def test_lead_tables_compare_systems_with_regressors():
    tasks = tasks_of(ROWS, BOTH, [0, 1, 2], 100, "digest")
    records = tidy(ROWS, tasks, [made_up(t) for t in tasks])
    papers, ours = Tables(ROWS, records).leads(["interleaved", "blocks"]).values()
    for table in (papers, ours):
        assert len(table.lines) == 2 * len(ROWS)
        assert len(set(table.header)) == len(table.header) == len(table.lines[0])
    first, own = (dict(zip(table.header, table.lines[0], strict=True)) for table in (papers, ours))
    assert first["condition"] == ROWS[0].label
    assert [first[f"published{k}"] for k in (", m", " regressor, m", " ratio")] == ["0.0534", "0.136", "2.5"]
    assert first["the paper's system here, m"] == "0.1100 ± 0.0100"
    assert first["plain regressor, m"] == "0.0550 ± 0.0050"
    assert first["plain / the paper's system here"] == first["tuned / the paper's system here"] == "0.50 ± 0.00"
    assert (own["ours, m"], own["tuned regressor, m"]) == ("0.0110 ± 0.0010", "0.0330 ± 0.0030")
    assert (own["plain / ours"], own["tuned / ours"]) == ("2.00 ± 0.00", "3.00 ± 0.00")
    alone = [record for record in records if record["method"] in PAPERS]
    assert [table.header for table in Tables(ROWS, alone).leads(["blocks"]).values()] == [papers.header]
    text = page("title", ROWS, alone, ["blocks"], ["how to read it"])
    assert all(f"| {METHODS[name]} |" in text for name in PAPERS)
    assert "ours" not in text


def test_rank_correlation_leaves_out_what_is_not_there():
    assert rank_correlation(np.array([1, 2, np.inf, 4]), np.array([1, 2, 3, np.nan])) == pytest.approx(1)
    assert rank_correlation(np.array([1, 1]), np.array([1, 2])) is None
    assert rank_correlation(np.array([]), np.array([])) is None


@pytest.fixture(scope="module")
def first_frames(small_world, tmp_path_factory):
    """A hundred frames of the small corridor's flight: what this test asks takes as long as there are frames."""
    folder = shutil.copytree(small_world.folder, tmp_path_factory.mktemp("first") / "corridor")
    for image in sorted((folder / "seq-01").glob("*.color.png"))[100:]:
        image.unlink()
        image.with_name(image.name.replace("color.png", "pose.txt")).unlink()
    return folder


@pytest.fixture(scope="module")
def ran(first_frames, small_world, tmp_path_factory):
    """Runs a command on it, one seed, one epoch, one split, always into one folder; gives that folder."""
    out = tmp_path_factory.mktemp("experiments")

    def run(command, *arguments):
        options = ["--out", out, "--epochs", 1, "--split", "interleaved", "--cache", small_world.cache]
        result = CliRunner().invoke(command.app, [str(a) for a in [first_frames, *options, *arguments]])
        assert result.exit_code == 0, result.output
        return result.output, out

    return run


@pytest.fixture(scope="module")
def papers(ran):
    return ran(table1, "--seeds", 1, "--method", "paper")


@pytest.mark.slow
def test_the_papers_system_alone(papers):
    output, out = papers
    assert output.splitlines()[-1] == f"results: {out.resolve()}"
    records = json.loads((out / "table1.json").read_text())
    assert {r["method"] for r in records} == set(PAPERS)
    assert {r["row"] for r in records} == {row.label for row in ROWS}
    assert np.isfinite([r["rmse_m"] for r in records]).all()
    by_method = {r["method"]: r for r in records if r["row"] == ROWS[0].label}
    assert by_method["paper"]["region_n_calibration"] == by_method["paper"]["frames_calibration"]
    assert by_method["paper_plain"]["ratio"] == pytest.approx(
        by_method["paper_tuned"]["rmse_m"] / by_method["paper_plain"]["rmse_m"]
    )
    text = (out / "table1.md").read_text()
    assert text.index("published, m") < text.index("## Split interleaved")
    assert "ours" not in text
    assert len(list((out / "tasks").glob("paper-*.json"))) == len(list((out / "tasks").iterdir())) == 4
    kept = read_trajectories(out / "runs" / "paper-interleaved-seed0-0.4-efficientnet_lite0-noise0.2")
    assert list(kept) == ["greedy", "plain", "softmax_mean", "tuned"]
    assert read_metrics(out)["configuration"]["method"] == "paper"


def check_pictures(folder, names):
    for name in names:
        root = ElementTree.parse(folder / f"{name}.svg").getroot()
        assert root.tag.endswith("svg")
        with Image.open(folder / f"{name}.png") as image:
            assert np.asarray(image.convert("L")).std() > 10  # there is something on it


@pytest.mark.slow
def test_figures_of_the_papers_system_alone(papers, ran):
    kept = {p: p.stat().st_mtime_ns for p in (papers[1] / "tasks").iterdir()}
    _, out = ran(figures, "--method", "paper")
    assert {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()} == kept
    names = json.loads((out / "figures" / "metrics.json").read_text())["figures"]
    numbers = ["figure1", "figure2a", "figure2b", "figure2cd", "figure4", "figure5", "figure6"]
    assert sorted(names) == sorted([*(f"{n}_paper" for n in numbers), "figure3"])
    check_pictures(out / "figures", names)


@pytest.mark.slow
def test_the_table_on_a_small_corridor_goes_on_and_is_drawn(papers, ran):
    out = papers[1]
    done = {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()}
    everything = ("--baselines", "all")
    output, _ = ran(table1, "--seeds", 1, *everything)
    assert output.splitlines()[-1] == f"results: {out.resolve()}"
    records = json.loads((out / "table1.json").read_text())
    assert {r["row"] for r in records} == {row.label for row in ROWS}
    assert {*METHODS, "online"} == {r["method"] for r in records}
    by_row = {r["row"]: r for r in records if r["method"] == "smoothed"}
    n = sum(by_row["80 % of the data"][f"frames_{part}"] for part in ("train", "calibration", "test"))
    small = by_row["40 % of the data"]
    assert small["frames_test"] == by_row["80 % of the data"]["frames_test"]
    assert small["frames_train"] + small["frames_calibration"] == pytest.approx(0.4 * n, abs=2)
    assert small["frames_calibration"] == pytest.approx(CALIBRATION_SHARE * 0.4 * n, abs=2)
    same = ("rmse_m", "rmse_deg")
    assert [small[k] for k in same] == [by_row["no noise"][k] for k in same]
    assert small["rmse_m"] != by_row["pixel noise 0.2"]["rmse_m"]
    assert np.isfinite([r["rmse_m"] for r in records]).all()
    kept = {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()}
    assert len(kept) == 8
    assert done.items() <= kept.items()  # the paper's were there
    (out / "table1.md").unlink()
    ran(table1, "--seeds", 1, *everything)
    assert {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()} == kept
    assert "| 40 % of the data |" in (out / "table1.md").read_text()

    ran(figures, *everything)
    assert {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()} == kept  # drawn from what is there
    names = json.loads((out / "figures" / "metrics.json").read_text())["figures"]
    assert len(names) == len(set(names)) == 12
    check_pictures(out / "figures", names)
    run = StoredRun.read(out / "runs" / "interleaved-seed0-0.4-efficientnet_lite0-noise0.2")
    error = np.linalg.norm(run.answer.positions_xyz - run.truth.positions_xyz, axis=1)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(by_row["pixel noise 0.2"]["rmse_m"], rel=1e-4)
    assert set(run.trajectories) == {*OURS, "online"}
    inside = [any(a <= p <= b for a, b in run.intervals(i, "x")) for i, p in enumerate(run.truth.positions_xyz[:, 0])]
    assert np.mean(inside) > 0.5
    (out / "runs" / "ours-interleaved-bins10" / "regions.jsonl").write_text("")
    with pytest.raises(ResultsError, match="differ in length"):
        StoredRun.read(out / "runs" / "ours-interleaved-bins10")


def test_fast_baselines_are_in_the_table_by_default():
    assert WhichBaselines.DEFAULT.names == ("local_regression",)
    assert set(WhichBaselines.ALL.names) == set(BASELINES) > set(WhichBaselines.DEFAULT.names)
    tasks = tasks_of(ROWS, BOTH, [0], 100, "digest", baselines=("local_regression",))
    assert {task.baselines for task in tasks if task.method is Method.PAPER} == {()}  # the paper's stands alone
    assert {task.baselines for task in tasks if task.method is Method.CONFORMODAL} == {("local_regression",)}
    other = tasks_of(ROWS, BOTH, [0], 100, "digest", baselines=("deep_ensemble",))[-1]
    assert (other.key, other.settings == tasks[-1].settings) == (tasks[-1].key, False)  # worked out again


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--networks", "efficientnet_lite0,efficientnet_lite0"], "a small, a middle and a large"),
        (["--networks", "a,b,c"], "backbone must be"),
        (["--address", "x"], "needs --engine ray"),
    ],
)
def test_options_that_cannot_be_used_are_refused_before_the_work(tmp_path, options, match):
    result = CliRunner().invoke(table1.app, ["data", "--out", str(tmp_path / "out"), *options])
    assert result.exit_code == 2
    assert match in " ".join(result.output.split())
    assert not (tmp_path / "out").exists()
