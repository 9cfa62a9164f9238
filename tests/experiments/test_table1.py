import json
import re
import shutil
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from markupsafe import escape
from PIL import Image
from scipy.stats import spearmanr
from typer.testing import CliRunner

from conformodal.cli.main import app
from conformodal.datasets import SplitKind
from conformodal.experiments import ExperimentError
from conformodal.experiments.baselines import BASELINES
from conformodal.experiments.table1 import (
    cost_table,
    lead_table,
    main_table,
    method_table,
    paper_region_table,
    region_table,
    rows_of,
    size_table,
    tasks_of,
    tidy,
    write_json,
    write_parquet,
)
from conformodal.experiments.table1.conditions import CALIBRATION_SHARE
from conformodal.experiments.table1.size_against_error import rank_correlation
from conformodal.experiments.table1.summary import METHODS
from conformodal.odometry import Method, ResultsError, read_metrics, read_trajectories
from conformodal.report.stored import StoredRun

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
    names = ("greedy", "softmax_mean", "plain", "classical")
    errors = {m: {"rmse_m": error / 2, "rmse_deg": 1.0, "median_m": 0.0, "median_deg": 0.0} for m in names}
    errors["greedy"]["rmse_m"] = error
    region = {"joint_coverage": 0.5, "coverage": 0.9, "length": [0.3] * 7, "intervals": 2.5}
    tested = {"errors": errors, "region": region, "answer_ms": {"plain": 0.1}}
    noise = {f"{s:g}": tested for s in task.sigmas}
    cost = {"greedy": {"train_s": 3.0, "n_parameters": 1_000_000}}
    return {"frames": {"train": 1, "calibration": 1, "test": 1}, "cost": cost, "noise": noise}


def made_up(task):
    """Results in which the conformal error is 0.01 + seed / 1000, and the classical one three times that.

    The paper's system errs ten times as much as ours, and the regressors on its features half of that.
    """
    ours = 0.01 + task.seed / 1000
    if task.method is Method.PAPER:
        return made_up_papers(task, 10 * ours)
    errors = {m: {"rmse_m": 2 * ours, "rmse_deg": 1.0, "median_m": 0.0, "median_deg": 0.0} for m in OURS}
    errors["smoothed"]["rmse_m"] = ours
    errors["classical"]["rmse_m"] = 3 * ours
    errors["deep_ensemble"]["rmse_m"] = 1.5 * ours
    region = {
        "joint_coverage": 0.9,
        "coverage": 0.95,
        "length": [0.1] * 7,
        "intervals": 1.5,
        "size_error_rank_correlation": None,
    }
    region["alone"] = {**region, "coverage": 0.93, "length": [0.4] * 7}
    # in a row the larger region has the smaller error; over rows of other noise it has the larger
    frames = {
        s: {"size_m": [1 + s, 2 + s], "error_m": [2 + 9 * s, 1 + 9 * s], "turn_rad_s": [None, 1.0]} for s in task.sigmas
    }
    cost = {"classical": {"train_s": 5.0, "n_parameters": 10}}
    tested = {"errors": errors, "region": region, "answer_ms": {"classical": 0.1}}
    noise = {f"{s:g}": {**tested, "frames": frames[s]} for s in task.sigmas}
    return {"frames": {"train": 1, "calibration": 1, "test": 1}, "cost": cost, "noise": noise}


def test_the_table_holds_every_row_with_ratios_seed_by_seed():
    tasks = tasks_of(ROWS, BOTH, [0, 1, 2], 100, "digest")
    records = tidy(ROWS, tasks, [made_up(t) for t in tasks])
    assert len(records) == len(ROWS) * 2 * 3 * len(METHODS)
    classical = [r for r in records if r["method"] == "classical"]
    assert {r["train_s"] for r in classical} == {5.0}
    assert all(r["ratio"] == pytest.approx(1) for r in classical)
    for split in ("interleaved", "blocks"):
        lines = main_table(ROWS, records, split).markdown().splitlines()
        assert len(lines) == 2 + len(ROWS)
        assert len({line.count("|") for line in lines}) == 1
        first = [cell.strip() for cell in lines[2].split("|")]
        assert first[1:7] == [
            ROWS[0].label,
            "0.0110 ± 0.0010",
            "1.00 ± 0.00",
            "0.0330 ± 0.0030",
            "1.00 ± 0.00",
            "3.00 ± 0.00",
        ]
        assert first[8] == "1.50 ± 0.00 deep ensemble of 5"
        assert first[12] == ""  # no correlation known
        assert first[13] == "2.5 (0.136 / 0.0534)"
        table = method_table(ROWS, records, split).markdown().splitlines()
        assert len(table) == 2 + len(METHODS)
        regions = region_table(ROWS, records, split)
        assert len({len(line) for line in [regions.header, *regions.lines]}) == 1
        assert regions.lines[0][3:7] == ["0.95 ± 0.00", "0.93 ± 0.00", "0.10 ± 0.00", "0.40 ± 0.00"]
        costs = cost_table(ROWS[1], records, split)
        assert costs.lines == [
            [METHODS["paper"], "0.1100 ± 0.0100", "3.0 ± 0.0", "", "4.0"],
            [METHODS["classical"], "0.0330 ± 0.0030", "5.0 ± 0.0", "0.10 ± 0.00", "0.0"],
        ]


def test_the_first_table_sets_both_systems_beside_the_published_numbers_and_their_own_regressors():
    tasks = tasks_of(ROWS, BOTH, [0, 1, 2], 100, "digest")
    records = tidy(ROWS, tasks, [made_up(t) for t in tasks])
    table = lead_table(ROWS, records, ["interleaved", "blocks"])
    assert len(table.lines) == 2 * len(ROWS)
    assert len(set(table.header)) == len(table.header) == len(table.lines[0])
    first = dict(zip(table.header, table.lines[0], strict=True))
    assert first["condition"] == ROWS[0].label
    assert [first[f"published: {k}"] for k in ("conformal, m", "classical, m", "ratio")] == ["0.0534", "0.136", "2.5"]
    assert first["the paper's system here, m"] == "0.1100 ± 0.0100"
    assert first["plain regressor on its features, m"] == "0.0550 ± 0.0050"
    assert first["plain / the paper's system"] == first["tuned / the paper's system"] == "0.50 ± 0.00"
    assert (first["ours, m"], first["tuned regressor on our features, m"]) == ("0.0110 ± 0.0010", "0.0330 ± 0.0030")
    assert (first["plain / ours"], first["tuned / ours"]) == ("2.00 ± 0.00", "3.00 ± 0.00")
    alone = [record for record in records if record["method"] in PAPERS]
    papers = lead_table(ROWS, alone, ["blocks"])
    assert papers.header == table.header[: len(papers.header)]
    assert papers.header[-1] == "tuned / the paper's system"
    assert len(method_table(ROWS, alone, "blocks").lines) == len(PAPERS)
    assert paper_region_table(ROWS, alone, "blocks").lines[0][1:] == [
        "0.90 ± 0.00",
        "0.50 ± 0.00",
        "0.30 ± 0.00",
        "2.50 ± 0.00",
    ]


def test_sizes_are_held_against_errors_over_rows_together():
    sizes, errors = [], []
    for sigma in (0.0, 0.05, 0.1, 0.2):
        sizes += [1 + sigma, 2 + sigma]
        errors += [2 + 9 * sigma, 1 + 9 * sigma]
    expected = f"{spearmanr(sizes, errors).statistic:.2f} ± 0.00"
    tasks = tasks_of(ROWS, BOTH, [0, 1], 100, "digest")
    table = size_table(ROWS, tasks, [made_up(t) for t in tasks], "blocks")
    # one turning rate, which does not vary; from condition to condition, size and error rise together
    assert table.lines[0] == ["noise 0 to 0.2", expected, "", "1.00 ± 0.00"]
    assert table.lines[1][0] == "all rows"
    assert table.lines[1][1] != expected


def test_rank_correlation_leaves_out_what_is_not_there():
    assert rank_correlation([1, 2, None, 4], [1, 2, 3, np.nan]) == pytest.approx(1)
    assert np.isnan(rank_correlation([1, 1], [1, 2]))
    assert np.isnan(rank_correlation([], []))


def test_parquet_and_json_hold_the_same_records(tmp_path):
    pq = pytest.importorskip("pyarrow.parquet")
    tasks = tasks_of(ROWS, BOTH, [0], 100, "digest")
    records = tidy(ROWS, tasks, [made_up(t) for t in tasks])
    write_json(records, tmp_path / "a.json")
    write_parquet(records, tmp_path / "a.parquet")
    back = pq.read_table(tmp_path / "a.parquet").to_pylist()
    assert json.loads((tmp_path / "a.json").read_text()) == records
    assert [{k: v for k, v in r.items() if v is not None} for r in back] == [
        {k: v for k, v in r.items() if v is not None} for r in records
    ]


def test_parquet_without_pyarrow_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ExperimentError, match=r"pip install 'conformodal\[arrow\]'"):
        write_parquet([{"a": 1}], tmp_path / "a.parquet")


@pytest.fixture(scope="module")
def first_half(small_world, tmp_path_factory):
    """The first half of the small corridor's flight: what this test asks takes as long as there are frames."""
    folder = shutil.copytree(small_world.folder, tmp_path_factory.mktemp("half") / "corridor")
    images = sorted((folder / "seq-01").glob("*.color.png"))
    for image in images[len(images) // 2 :]:
        image.unlink()
        image.with_name(image.name.replace("color.png", "pose.txt")).unlink()
    return folder


@pytest.fixture(scope="module")
def reproduce(first_half, small_world, tmp_path_factory):
    """Runs ``reproduce`` on it, one seed, one epoch, one split, always into one folder; gives that folder."""
    out = tmp_path_factory.mktemp("reproduced")

    def run(*arguments):
        options = ["--out", out, "--epochs", 1, "--split", "interleaved", "--cache", small_world.cache]
        everything = ["reproduce", arguments[0], first_half, *options, "--workers", 1, *arguments[1:]]
        result = CliRunner().invoke(app, [str(a) for a in everything])
        assert result.exit_code == 0, result.output
        return result.output, out

    return run


@pytest.fixture(scope="module")
def papers(reproduce):
    return reproduce("table1", "--seeds", 1, "--method", "paper")


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
        by_method["paper_classical"]["rmse_m"] / by_method["paper_plain"]["rmse_m"]
    )
    text = (out / "table1.md").read_text()
    assert text.index("published: conformal, m") < text.index("## Split interleaved")
    assert "ours" not in text
    assert escape("the paper's system here, m") in (out / "table1.html").read_text()
    assert len(list((out / "tasks").glob("paper-*.json"))) == len(list((out / "tasks").iterdir())) == 4
    kept = read_trajectories(out / "runs" / "paper-interleaved-seed0-0.4-efficientnet_lite0-noise0.2")
    assert list(kept) == ["greedy", "classical", "plain", "softmax_mean"]
    assert read_metrics(out)["configuration"]["method"] == "paper"


def check_pictures(folder, names):
    for name in names:
        root = ElementTree.parse(folder / f"{name}.svg").getroot()
        assert root.tag.endswith("svg")
        with Image.open(folder / f"{name}.png") as image:
            assert np.asarray(image.convert("L")).std() > 10  # there is something on it


@pytest.mark.slow
def test_figures_of_the_papers_system_alone(papers, reproduce):
    kept = {p: p.stat().st_mtime_ns for p in (papers[1] / "tasks").iterdir()}
    _, out = reproduce("figures", "--method", "paper")
    assert {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()} == kept
    names = json.loads((out / "figures" / "metrics.json").read_text())["figures"]
    numbers = ["figure1", "figure2a", "figure2b", "figure2cd", "figure4", "figure5", "figure6"]
    assert sorted(names) == sorted([*(f"{n}_paper" for n in numbers), "figure3"])
    check_pictures(out / "figures", names)


@pytest.mark.slow
def test_reproduce_table1_on_a_small_corridor_and_go_on(papers, reproduce):
    out = papers[1]
    done = {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()}
    everything = ("--baselines", "all")
    output, _ = reproduce("table1", "--seeds", 1, *everything)
    assert output.splitlines()[-1] == f"results: {out.resolve()}"
    records = json.loads((out / "table1.json").read_text())
    assert {r["row"] for r in records} == {row.label for row in ROWS}
    assert {*METHODS, "online"} == {r["method"] for r in records}
    page = (out / "table1.html").read_text()
    assert page.count("<svg") == 1
    assert all(f">{escape(name)}</th>" in page for name in METHODS.values())
    assert not re.search(r'(src|href)="http', page)  # readable without a network
    assert (out / "table1.parquet").is_file()
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
    seconds = read_metrics(out)["seconds"]
    reproduce("table1", "--seeds", 1, *everything)
    assert {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()} == kept
    assert "| 40 % of the data |" in (out / "table1.md").read_text()
    assert read_metrics(out)["seconds"] > seconds  # of both

    reproduce("figures", *everything)
    assert {p: p.stat().st_mtime_ns for p in (out / "tasks").iterdir()} == kept  # drawn from what is there
    names = json.loads((out / "figures" / "metrics.json").read_text())["figures"]
    assert len(names) == len(set(names)) == 14
    check_pictures(out / "figures", names)
    run = StoredRun.read(out / "runs" / "interleaved-seed0-0.4-efficientnet_lite0-noise0.2")
    error = np.linalg.norm(run.answer.positions_xyz - run.truth.positions_xyz, axis=1)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(by_row["pixel noise 0.2"]["rmse_m"], rel=1e-4)
    assert set(run.trajectories) == {*OURS, "online"}
    inside = [any(a <= p <= b for a, b in run.intervals(i, "x")) for i, p in enumerate(run.truth.positions_xyz[:, 0])]
    assert np.mean(inside) > 0.5
    (out / "runs" / "interleaved-bins10" / "regions.jsonl").write_text("")
    with pytest.raises(ResultsError, match="differ in length"):
        StoredRun.read(out / "runs" / "interleaved-bins10")


def test_baselines_that_take_seconds_stand_in_the_table_by_default():
    from conformodal.cli.reproduce import WhichBaselines

    assert WhichBaselines.DEFAULT.names == ("local_regression",)
    assert set(WhichBaselines.ALL.names) == set(BASELINES) > set(WhichBaselines.DEFAULT.names)
    tasks = tasks_of(ROWS, BOTH, [0], 100, "digest", baselines=("local_regression",))
    assert {task.baselines for task in tasks if task.method is Method.PAPER} == {()}  # the paper's stands alone
    assert {task.baselines for task in tasks if task.method is Method.CONFORMODAL} == {("local_regression",)}
    other = tasks_of(ROWS, BOTH, [0], 100, "digest", baselines=("deep_ensemble",))[-1]
    assert (other.key, other.settings == tasks[-1].settings) == (tasks[-1].key, False)  # worked out again


def test_engines_by_name():
    from conformodal.cli.reproduce import EngineKind, _engine
    from conformodal.experiments import LocalEngine, RayEngine

    assert _engine(EngineKind.RAY, 1, "auto") == RayEngine("auto")
    assert _engine(EngineKind.LOCAL, 3, None) == LocalEngine(3)
