"""Monitoring at the command line: rows of tables, and runs of a model."""

import json

import numpy as np
import pandas as pd
import pytest

from conformodal.cli.monitor_runs import scores_of_runs
from conformodal.conformal import ConformalRegressor
from conformodal.pipeline.results import METRICS, REGIONS, ResultsWriter
from conformodal.pipeline.store import model_digest, save_model
from tests.helpers import invoke, refusal, run_ok
from tests.small_model import small_model

pytestmark = pytest.mark.usefixtures("short_fits")


def table(n, seed, shift=0.0, subjects=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, n)
    frame = pd.DataFrame({"x": x.round(4), "y": (x + rng.normal(shift, 0.1, n)).round(4)})
    if subjects:
        frame["subject"] = [f"s{i}" for i in np.repeat(np.arange(subjects), -(-n // subjects))[:n]]
    return frame


@pytest.fixture(scope="module")
def fitted(short_fits, tmp_path_factory):
    """A saved regressor of y on x."""
    folder = tmp_path_factory.mktemp("fitted")
    path, frame = folder / "model.skops", table(600, 20)
    ConformalRegressor("quick", random_state=0).fit(frame[["x"]], frame["y"]).save(path)
    return path


def test_only_shifted_rows_raise_an_alarm(fitted, tmp_path):
    first, second = tmp_path / "january.csv", tmp_path / "february.csv"
    table(150, 21).to_csv(first, index=False)
    table(150, 22, shift=0.3).to_csv(second, index=False)
    calm = json.loads(run_ok("monitor", fitted, first, "--json").stdout)
    assert calm["alarm"] is None
    assert (calm["n_before"], calm["n_new"], calm["unit"]) == (120, 150, "row")
    result = invoke("monitor", fitted, first, second)
    assert result.exit_code == 1
    assert f"alarm at {second}, line" in result.output
    assert "scores of true values are larger" in result.output


def test_the_seed_alone_decides_ties(fitted, tmp_path):
    file = tmp_path / "rows.csv"
    table(40, 23).to_csv(file, index=False)
    one, again, other = (
        json.loads(run_ok("monitor", fitted, file, "--seed", seed, "--json").stdout)["p_values"]["y"]
        for seed in (1, 1, 2)
    )
    assert one == again != other


def test_rows_without_a_target_are_counted_and_named(fitted, tmp_path):
    frame, file = table(60, 24), tmp_path / "gaps.csv"
    frame.loc[[3, 5], "y"] = np.nan
    frame.to_csv(file, index=False)
    result = run_ok("monitor", fitted, file)
    assert "left out: 2 rows without y (lines 5, 7)" in " ".join(result.output.split())
    assert "of 58 rows" in result.output


def test_units_are_monitored_whole(tmp_path):
    frame, path, file = table(900, 25, subjects=90), tmp_path / "model.skops", tmp_path / "new.csv"
    regressor = ConformalRegressor("quick", random_state=0).fit(frame[["x"]], frame["y"], units=frame["subject"])
    regressor.save(path)
    table(200, 26, subjects=20).to_csv(file, index=False)
    assert "--unit must name the column" in refusal("monitor", path, file)
    record = json.loads(run_ok("monitor", path, file, "--unit", "subject", "--json").stdout)
    assert record["n_new"] == 20
    assert record["n_before"] == regressor.calibrator_.n_units
    assert record["units"][0] == "subject s0"


def test_what_cannot_be_monitored_is_refused(fitted, tmp_path):
    file = tmp_path / "rows.csv"
    table(40, 27).drop(columns="y").to_csv(file, index=False)
    assert "has no column 'y'" in refusal("monitor", fitted, file)
    assert "--unit must be left out" in refusal("monitor", fitted, file, "--unit", "x")
    table(40, 27).to_csv(file, index=False)
    assert "level must be" in refusal("monitor", fitted, file, "--level", "2")


def written_run(folder, model_folder, scores=None, known_p=None, n_recordings=1):
    """A folder of results with these scores or p-values, frame by frame."""
    values = scores if scores is not None else known_p
    intervals = {name: [[0, 1]] for name in ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")}
    with ResultsWriter(folder) as writer:
        for i, value in enumerate(values):
            record = {"timestamp_s": float(i), "frame": f"{i}.png", "motion": "ok", "evidence": "landmarks"}
            record["recording"] = i * n_recordings // len(values)
            record |= {"reliable": True, "intervals": intervals, "places": None, "path_places": None}
            writer.region(
                record | {"score": value if scores is not None else None, "known_p": None if known_p is None else value}
            )
            writer._write("trajectory.tum", [f"{i} 0 0 0 0 0 0 1"])
        metrics = {"command": "run", "model": model_digest(model_folder), "configuration": {"method": "conformodal"}}
        writer.publish({**metrics, "sign_reference_quat_wxyz": [1, 0, 0, 0], "results": writer.digests})
    return folder


@pytest.fixture
def model_folder(tmp_path):
    model = small_model()
    model.configuration["whole_recordings"] = True
    save_model(model, tmp_path / "model")
    return tmp_path / "model"


def test_each_recording_is_a_unit_where_recordings_calibrate(model_folder, tmp_path):
    runs = [written_run(tmp_path / f"run-{k}", model_folder, [0.1 * k, 0.2, 0.3, None]) for k in range(3)]
    monitored = scores_of_runs(model_folder, runs, 0)
    assert monitored.noun == "recording"
    assert monitored.new[:, 0].tolist() == pytest.approx([0.3, 0.3, 0.3])  # 80 % of three frames are at most the third
    assert len(monitored.before) == 20
    result = run_ok("monitor", model_folder, *runs)
    assert "left out: 3 frames without a true pose" in result.output


def test_the_recordings_of_a_run_are_units_of_their_own(model_folder, tmp_path):
    run = written_run(tmp_path / "run", model_folder, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], n_recordings=2)
    assert scores_of_runs(model_folder, [run], 0).new[:, 0].tolist() == pytest.approx([0.3, 0.6])


def test_recordings_that_fit_badly_raise_an_alarm(model_folder, tmp_path):
    runs = [written_run(tmp_path / f"run-{k}", model_folder, [1e300] * 5) for k in range(30)]
    result = invoke("monitor", model_folder, *runs)
    assert result.exit_code == 1
    assert "regions miss too much" in result.output


def test_runs_without_truth_are_tested_for_novelty(model_folder, tmp_path):
    runs = [written_run(tmp_path / f"run-{k}", model_folder, known_p=[0.5, 0.9]) for k in range(2)]
    result = run_ok("monitor", model_folder, *runs)
    assert "novelty of 2 recordings" in result.output
    assert "not coverage" in result.output


def test_runs_without_truth_among_others_are_named(model_folder, tmp_path):
    runs = [written_run(tmp_path / "a", model_folder, [0.1]), written_run(tmp_path / "b", model_folder, known_p=[0.5])]
    assert f"1 recording without true poses: {tmp_path / 'b'}" in " ".join(
        run_ok("monitor", model_folder, *runs).output.split()
    )


def test_runs_of_another_model_or_given_twice_are_refused(model_folder, tmp_path):
    run = written_run(tmp_path / "run", model_folder, [0.1])
    assert "is given twice" in refusal("monitor", model_folder, run, run)
    metrics = json.loads((run / METRICS).read_text())
    (run / METRICS).write_text(json.dumps({**metrics, "model": "another"}))
    assert "is not a run of the model" in refusal("monitor", model_folder, run)
    assert (run / REGIONS).is_file()


def with_model_of(tmp_path, text):
    """A regressor that `table fit` made of a file."""
    file, model = tmp_path / "fit.csv", tmp_path / "model.skops"
    file.write_text(text)
    run_ok("table", "fit", file, "--target", "price", "--model", model)
    return model


def rows_in(unit, n=400, seed=30):
    rng = np.random.default_rng(seed)
    weight = rng.uniform(1, 9, n)
    price = 10 * weight + rng.normal(0, 1, n)
    cells = zip(weight.round(3), price.round(2), strict=True)
    return "weight,price\n" + "".join(f"{w} {unit},{p}\n" for w, p in cells)


def test_rows_are_read_as_the_regressor_expects_them(tmp_path):
    model, file = with_model_of(tmp_path, rows_in("kg")), tmp_path / "new.csv"
    file.write_text(rows_in("g", 30, 31))
    assert "'g'" in refusal("monitor", model, file)
    file.write_text(rows_in("kg", 30, 31).replace(",5", ",<5", 1))
    assert "target 'price'" in refusal("monitor", model, file)
    file.write_text(rows_in("kg", 30, 31))
    assert json.loads(run_ok("monitor", model, file, "--json").stdout)["n_new"] == 30


def test_rows_are_read_as_they_are_named(tmp_path):
    rng = np.random.default_rng(5)
    days = pd.to_datetime("2024-01-01") + pd.to_timedelta(rng.integers(0, 300, 460), "D")
    price = 1000 * rng.uniform(1, 9, 460)
    cells = [f"{day:%Y-%m-%d},{p:.2f},{2 * p + rng.normal():.2f}\n" for day, p in zip(days, price, strict=True)]
    model, file = with_model_of(tmp_path, "sold,cost,price\n" + "".join(cells[:400])), tmp_path / "new.csv"
    file.write_text("sold,cost,price\n" + "".join(cells[400:]))
    plain = json.loads(run_ok("monitor", model, file, "--json").stdout)
    assert plain["n_new"] == 60
    rows = [cell.strip().split(",") for cell in cells[400:]]
    written = [f"{d[8:]}/{d[5:7]}/{d[2:4]};{float(c):,.2f};{float(p):,.2f}" for d, c, p in rows]
    swapped = [row.translate(str.maketrans(",.", ".,")) for row in [*written, "?;1,000.00;?"]]
    file.write_text("sold;cost;price\n" + "\n".join(swapped) + "\n")
    named = ["--sep", ";", "--decimal", ",", "--thousands", ".", "--na", "?", "--date", "sold=%d/%m/%y"]
    result = run_ok("monitor", model, file, *named, "--json")
    assert json.loads(result.stdout)["p_values"] == plain["p_values"]
    assert "left out: 1 row without price" in " ".join(result.output.split())
    assert "may have marks between thousands" in refusal("monitor", model, file)
    assert "--decimal, --date: for tables" in refusal("monitor", tmp_path, file, *named[2:4], *named[-2:])


def test_rows_of_totals_are_left_out(tmp_path):
    rng = np.random.default_rng(3)
    named = [f"shop {i},{x:.3f},{10 * x + rng.normal():.2f}\n" for i, x in enumerate(rng.uniform(1, 9, 460))]
    model = with_model_of(tmp_path, "shop,weight,price\n" + "".join(named[:400]))
    file = tmp_path / "new.csv"
    file.write_text("shop,weight,price\n" + "".join(named[400:]) + "Total,300,3000\n")
    result = run_ok("monitor", model, file, "--json")
    assert json.loads(result.stdout)["n_new"] == 60
    assert "1 row with totals of the others" in result.output
