"""What belongs together stays together: owners of folders, earlier results, models, and what a killed run leaves."""

import errno
import json
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from conformodal.cli.main import app
from conformodal.core import files as core_files
from conformodal.core.files import FolderError, FolderInUseError, check_writable, write_whole, writing_in
from conformodal.odometry import (
    ResultsError,
    ResultsWriter,
    load_model,
    read_region_records,
    read_trajectories,
    save_model,
    write_metrics,
)
from conformodal.odometry.results.folders import FINISHED, UNFINISHED, check_belongs, claimed, result_digests, settle
from conformodal.poses import Trajectory, write_tum

HOLDS = {
    "a model": {"model.json": "{}"},
    "a model and its numbers": {"model.json": "{}", "metrics.json": '{"command": "train"}'},
    "a run": {"regions.jsonl": "", "metrics.json": '{"command": "run"}'},
    "a killed run": {"regions.jsonl": ""},
    "a demo": {"corridor/x": "", "regions.jsonl": "", "metrics.json": '{"command": "demo"}'},
    "a killed demo": {"corridor/x": ""},
    "a reproduction": {"tasks/x": "", "metrics.json": '{"command": "reproduce table1"}'},
    "a killed reproduction": {"tasks/x": ""},
    "an evaluation": {"metrics.json": '{"command": "evaluate"}'},
    "findings": {"metrics.json": '{"command": "data check"}'},
    "broken numbers": {"metrics.json": "{"},
    "numbers of something else": {"metrics.json": "[1]"},
    "no text": {"metrics.json": b"\xff\xfe"},
    "other files": {"notes.txt": "mine"},
    "nothing": {},
}
ALLOWED = {
    "train": {"a model", "a model and its numbers"},
    "run": {"a run", "a killed run"},
    "demo": {"a demo", "a killed demo"},
    "reproduce": {"a reproduction", "a killed reproduction"},
    "evaluate": {"an evaluation"},
}


def fill(folder: Path, files) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def everything(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("command", ALLOWED)
@pytest.mark.parametrize("what", HOLDS)
def test_a_folder_belongs_to_one_command(tmp_path, command, what):
    fill(tmp_path, HOLDS[what])
    before = everything(tmp_path)
    if what in ALLOWED[command] | {"other files", "nothing"}:
        with claimed(tmp_path, command):
            assert (tmp_path / ".lock").read_text().strip() == str(os.getpid())
    else:
        with pytest.raises(FolderError, match=f"{command} would overwrite"), claimed(tmp_path, command):
            pass
        with pytest.raises(FolderError, match=f"{command} would overwrite"):
            write_metrics(tmp_path, {"command": command})
    assert everything(tmp_path) == before


UNUSABLE = {
    "a file": (lambda p: (p / "f").write_text("x"), "f", "f is a file"),
    "below a file": (lambda p: (p / "f").write_text("x"), "f/g/h", "f is a file"),
    "a broken link": (lambda p: (p / "l").symlink_to(p / "gone"), "l", "broken link"),
    "a null byte": (lambda p: None, "a\0b", "no name of a folder"),
    "too long a name": (lambda p: None, "x" * 300, "too long"),
    "too long a path": (lambda p: None, "/".join(["x" * 200] * 30), "too long"),
}


@pytest.mark.parametrize("why", UNUSABLE)
def test_folders_that_cannot_be_written_are_refused_and_nothing_is_left(tmp_path, why):
    prepare, name, said = UNUSABLE[why]
    prepare(tmp_path)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(FolderError, match=said), claimed(tmp_path / name, "run"):
        pass
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.EIO])
@pytest.mark.parametrize("call", ["mkdir", "probe"])
def test_what_the_system_refuses_is_a_kind_error(tmp_path, monkeypatch, number, call):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    if call == "mkdir":
        monkeypatch.setattr(Path, "mkdir", refuse)
    else:
        monkeypatch.setattr(core_files.tempfile, "TemporaryFile", refuse)
    with pytest.raises(FolderError, match=f"new: cannot be written: {os.strerror(number)}"):
        check_writable(tmp_path / "new")


def test_a_full_disk_is_seen_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(core_files.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10, 10, 0))
    with pytest.raises(FolderError, match="disk is full"):
        check_writable(tmp_path)


def test_a_folder_that_is_read_is_not_written(tmp_path):
    with pytest.raises(FolderError, match="is read from"), claimed(tmp_path, "train", apart=[tmp_path]):
        pass


HOLD = "import sys; from pathlib import Path; from conformodal.core.files import writing_in\n"
HOLD += "with writing_in(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"


def test_a_folder_in_use_is_refused_until_its_process_dies(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout.readline() == b"held\n"
        for command in ("train", "run", "demo"):
            with pytest.raises(FolderInUseError, match=f"in use by process {other.pid}"), claimed(tmp_path, command):
                pass
        with pytest.raises(FolderInUseError):
            ResultsWriter(tmp_path)
        other.kill()
    (tmp_path / f".x.1{core_files.PART}").write_text("half a file")
    with writing_in(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    write_whole(tmp_path / "x", "old")

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        write_whole(tmp_path / "x", "new")
    assert everything(tmp_path) == {"x": b"old"}


def path_of(n, shift=0.0, start=0.0):
    times = start + 0.1 * np.arange(n)
    places = np.column_stack((np.cos(times), np.sin(times), 0 * times)) + shift
    return Trajectory(times, places, np.tile([1.0, 0, 0, 0], (n, 1)))


def write_results(folder, n=6, shift=0.0, truth=True, after=None):
    """A made-up run; `after` frames it breaks off."""
    path = path_of(n, shift)
    with ResultsWriter(folder) as writer:
        write_metrics(writer.place, {"command": "run", "unfinished": True})
        for i in range(n):
            if i == after:
                raise OSError(errno.ENOSPC, "No space left on device")
            parts = [np.array([[v - 0.2, v + 0.2]]) for v in (*path.positions_xyz[i], 1.0, 0.0, 0.0, 0.0)]
            writer.region(f"frame-{i}", float(path.timestamps_s[i]), None, parts)
            writer.poses("online", path[i : i + 1])
        if n == after:
            raise KeyboardInterrupt
        writer.poses("smoothed", path)
        if truth:
            writer.truth(path)
        done = {"command": "run", "configuration": {}, "seed": 0, "sign_reference_quat_wxyz": [1, 0, 0, 0]}
        write_metrics(writer.place, {**done, "results": result_digests(writer.place)})


@pytest.mark.parametrize("after", range(7))
def test_earlier_results_stay_where_the_next_run_breaks_off(tmp_path, after):
    write_results(tmp_path)
    (tmp_path / "evaluation").mkdir()
    write_metrics(tmp_path / "evaluation", {"command": "evaluate"})
    before = everything(tmp_path)
    with pytest.raises((OSError, KeyboardInterrupt)):
        write_results(tmp_path, shift=1.0, after=after)
    kept = everything(tmp_path)
    assert {k: v for k, v in kept.items() if not k.startswith(UNFINISHED)} == before
    assert any(k.startswith(UNFINISHED) for k in kept) == (after > 0)
    write_results(tmp_path, shift=1.0)
    assert "evaluation/metrics.json" not in everything(tmp_path)
    assert read_trajectories(tmp_path)["smoothed"].positions_xyz[0, 0] == pytest.approx(2)


def test_a_first_run_without_an_answer_leaves_nothing(tmp_path):
    with pytest.raises(OSError, match="No space"):
        write_results(tmp_path / "new", after=0)
    assert not (tmp_path / "new").exists() or not everything(tmp_path)


class Killed(BaseException):
    pass


@pytest.mark.parametrize("moment", range(1, 9))
def test_a_replacement_that_was_killed_is_brought_to_its_end(tmp_path, monkeypatch, moment):
    write_results(tmp_path / "expected", shift=1.0, truth=False)
    write_results(tmp_path / "out")
    before = everything(tmp_path / "out")
    for name in ("rename", "replace"):
        moves, original = [], getattr(Path, name)

        def move(self, target, original=original, moves=moves):
            if target.parent.name == "out" and not self.name.startswith("."):
                moves.append(target)
                if len(moves) == moment:
                    raise Killed
            return original(self, target)

        monkeypatch.setattr(Path, name, move)
    with suppress(Killed):
        write_results(tmp_path / "out", shift=1.0, truth=False)
    monkeypatch.undo()
    committed = (tmp_path / "out" / FINISHED).exists() or not (tmp_path / "out" / UNFINISHED).exists()
    settle(tmp_path / "out")
    found = everything(tmp_path / "out")
    found = {k: v for k, v in found.items() if not k.startswith(UNFINISHED)}
    assert found == (everything(tmp_path / "expected") if committed else before)


def test_numbers_of_other_results_are_refused(tmp_path):
    write_results(tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    check_belongs(tmp_path, metrics)
    write_tum(tmp_path / "trajectory.tum", path_of(6, 3.0))
    with pytest.raises(FolderError, match=r"trajectory\.tum: is not the file"):
        check_belongs(tmp_path, metrics)


def invoke(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def drop(*names):
    return lambda f: [(f / name).unlink() for name in names]


def cut(name, n):
    return lambda f: (f / name).write_bytes((f / name).read_bytes()[:-n])


def killed(*changes):
    def change(folder):
        (folder / "metrics.json").write_text('{"command": "run", "unfinished": true}')
        for each in changes:
            each(folder)

    return change


LEFT = {
    "no metrics": (drop("metrics.json"), 6),
    "killed at the end": (killed(), 6),
    "half a region": (killed(cut("regions.jsonl", 30)), 5),
    "half a pose": (killed(cut("trajectory.tum", 30)), 5),
    "half an online pose": (killed(cut("methods/online.tum", 3)), 5),
    "no answer yet": (killed(drop("trajectory.tum", "truth.tum")), 6),
    "no pose yet": (killed(drop("trajectory.tum", "methods/online.tum")), 6),
    "half of both, no metrics": (
        lambda f: [d(f) for d in (drop("metrics.json", "trajectory.tum"), cut("regions.jsonl", 9))],
        5,
    ),
}


@pytest.mark.parametrize("left", LEFT)
def test_what_a_killed_run_left_is_evaluated(tmp_path, left):
    change, n = LEFT[left]
    write_results(tmp_path / "out")
    write_tum(tmp_path / "truth.tum", path_of(6))
    change(tmp_path / "out")
    result = invoke("evaluate", tmp_path / "out", "--truth", tmp_path / "truth.tum")
    assert result.exit_code == 0, result.output
    assert "did not come to its end" in result.output
    found = json.loads((tmp_path / "out" / "evaluation" / "metrics.json").read_text())
    assert (found["n_answered"], found["unfinished"], found["coverage"]["joint_coverage"]) == (n, True, 1.0)


def said_in_metrics(**changes):
    def change(folder):
        path = folder / "metrics.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


REFUSED = {
    "metrics are broken": (lambda f: (f / "metrics.json").write_text("{"), "cannot be read as metrics"),
    "metrics are nested without end": (lambda f: (f / "metrics.json").write_text("[" * 99999), "cannot be read"),
    "results are a list": (said_in_metrics(results=[1]), "results is [1], expected an object"),
    "settings are a list": (said_in_metrics(configuration=[1]), "configuration is [1]"),
    "signs are a word": (said_in_metrics(sign_reference_quat_wxyz="x"), "expected four numbers"),
    "signs are three": (said_in_metrics(sign_reference_quat_wxyz=[1, 0, 0]), "expected four numbers"),
    "signs are null": (said_in_metrics(sign_reference_quat_wxyz=[None, 0, 0, 1]), "expected four numbers"),
    "signs are zero": (said_in_metrics(sign_reference_quat_wxyz=[0, 0, 0, 0]), "expected four numbers"),
    "the seed is NaN": (said_in_metrics(seed=float("nan")), "cannot be read as metrics: holds NaN"),
    "a method has other times": (
        lambda f: write_tum(f / "methods" / "online.tum", replace(path_of(6), timestamps_s=9 + np.arange(6.0))),
        "poses of online have other times",
    ),
    "regions are missing": (drop("regions.jsonl"), "regions.jsonl: cannot be read"),
    "regions are others": (cut("regions.jsonl", 400), "regions.jsonl"),
    "the answer is another": (cut("trajectory.tum", 90), "is not the file"),
    "regions are no text": (lambda f: (f / "regions.jsonl").write_bytes(b"\xff\xfe{}\n"), "line 1"),
    "regions are numbers": (lambda f: (f / "regions.jsonl").write_text("1\n"), "line 1"),
    "nothing was answered": (killed(lambda f: (f / "regions.jsonl").write_text("")), "before it had answered"),
}


@pytest.mark.parametrize("why", REFUSED)
def test_results_that_cannot_be_evaluated_are_refused(tmp_path, why):
    change, said = REFUSED[why]
    write_results(tmp_path / "out")
    write_tum(tmp_path / "truth.tum", path_of(6))
    change(tmp_path / "out")
    before = everything(tmp_path / "out")
    result = invoke("evaluate", tmp_path / "out", "--truth", tmp_path / "truth.tum")
    assert result.exit_code == 2, result.output
    assert said in " ".join(result.output.split())
    assert everything(tmp_path / "out") == before


RECORD = {"timestamp_s": 1.0, "frame": "f", "motion": "first", "reliable": True}
WHOLE = {t: [[0, 1]] for t in ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")}
LINES = {
    "a list": [],
    "no intervals": RECORD,
    "intervals of others": {**RECORD, "intervals": {"x": []}},
    "no time": {**RECORD, "intervals": WHOLE, "timestamp_s": None},
    "a huge time": {**RECORD, "intervals": WHOLE, "timestamp_s": 10**400},
    "a name that is a number": {**RECORD, "intervals": WHOLE, "frame": 3},
    "three ends": {**RECORD, "intervals": {**WHOLE, "x": [[0, 1, 2]]}},
    "ends of text": {**RECORD, "intervals": {**WHOLE, "x": [["0", "1"]]}},
    "no pairs": {**RECORD, "intervals": {**WHOLE, "x": [1, 2]}},
    "infinite ends": {**RECORD, "intervals": {**WHOLE, "x": [[0, float("inf")]]}},
    "no reliability": {"timestamp_s": 1.0, "frame": "f", "motion": "first", "intervals": WHOLE},
}


@pytest.mark.parametrize("what", LINES)
@pytest.mark.parametrize("torn", [False, True])
def test_records_that_are_none_are_named(tmp_path, what, torn):
    path = tmp_path / "regions.jsonl"
    path.write_text(json.dumps({**RECORD, "intervals": WHOLE}) + "\n" + json.dumps(LINES[what]) + "\n")
    with pytest.raises(ResultsError, match="line 2"):
        read_region_records(path, torn=torn)


@pytest.fixture(scope="module")
def model(small_world):
    return load_model(small_world.model)


@pytest.mark.parametrize("moment", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("first", [False, True])
def test_a_model_is_whole_whenever_saving_is_killed(model, tmp_path, monkeypatch, moment, first):
    if not first:
        save_model(model, tmp_path)
    other = replace(model, localizer=replace(model.localizer, sign_reference=-model.sign_reference))
    moves, move = [], Path.replace

    def counted(self, target):
        moves.append(target)
        if len(moves) == moment:
            raise Killed
        return move(self, target)

    monkeypatch.setattr(Path, "replace", counted)
    with suppress(Killed):
        save_model(other, tmp_path)
    monkeypatch.undo()
    if first and moment <= 3:
        assert not (tmp_path / "model.json").exists()
    else:
        found = load_model(tmp_path).sign_reference
        np.testing.assert_array_equal(found, model.sign_reference if moment <= 3 else other.sign_reference)
    save_model(other, tmp_path)
    np.testing.assert_array_equal(load_model(tmp_path).sign_reference, other.sign_reference)
    names = sorted(p.name for p in tmp_path.iterdir())
    assert [name.partition("-")[0] for name in names] == ["model.json", "network", "weights.safetensors"]


def test_run_refuses_its_model_and_its_source(small_world, tmp_path):
    shutil.copytree(small_world.model, tmp_path / "m")
    before = everything(tmp_path / "m")
    for out in (tmp_path / "m", small_world.folder):
        result = invoke("run", tmp_path / "m", small_world.folder, "--out", out)
        assert result.exit_code == 2, result.output
        assert len(result.stderr.splitlines()) == 1
    assert everything(tmp_path / "m") == before
    (tmp_path / "mine").mkdir()
    write_tum(tmp_path / "mine" / "truth.tum", path_of(3))
    result = invoke("run", tmp_path / "m", small_world.folder, "--out", tmp_path / "mine")
    assert "was not written by run" in result.stderr
    assert len(everything(tmp_path / "mine")) == 1


def test_a_source_without_a_readable_frame_leaves_earlier_results(small_world, tmp_path):
    (tmp_path / "bad").mkdir()
    for name in ("camera-intrinsics.txt", "frame-rate.txt"):
        shutil.copy(small_world.folder / name, tmp_path / "bad")
    good = sorted((small_world.folder / "seq-01").glob("*.png"))[:2]
    for path in good:
        shutil.copy(path, tmp_path / "bad")
    write_results(tmp_path / "out")
    before = everything(tmp_path / "out")
    for path in (tmp_path / "bad").glob("*.png"):
        path.write_bytes(path.read_bytes()[:200])
    result = invoke("run", small_world.model, tmp_path / "bad", "--out", tmp_path / "out", "--format", "images")
    assert result.exit_code == 2, result.output
    assert everything(tmp_path / "out") == before


# files of the names that a command writes, where it has not written any
STRAYS = {
    "run": ["report.html", "truth.tum"],
    "train": ["weights.safetensors"],
    "demo": ["model/model.json", "report.html", "corridor/seq-01/frame-000000.color.png"],
}


@pytest.mark.parametrize(("command", "name"), [(c, name) for c, names in STRAYS.items() for name in names])
def test_files_of_others_are_not_overwritten(small_world, tmp_path, command, name):
    fill(tmp_path, {name: "mine", "notes.txt": "mine too"})
    before = everything(tmp_path)
    source, end = small_world.folder, ("--out", tmp_path)
    start = {
        "run": ("run", small_world.model, source),
        "train": ("train", source),
        "demo": ("demo",),
    }[command]
    result = invoke(*start, *end)
    assert result.exit_code == 2, result.output
    assert f"was not written by {command}" in result.stderr
    assert everything(tmp_path) == before


def test_a_rerun_takes_away_its_own_files_alone(tmp_path):
    write_results(tmp_path)
    mine = {"evaluation/notes.txt": "mine", "methods/notes.txt": "mine"}
    old = {"evaluation/metrics.json": '{"command": "evaluate"}', "methods/old.tum": "", "regions.parquet": ""}
    fill(tmp_path, mine | old)
    write_results(tmp_path, shift=1.0, truth=False)
    found = everything(tmp_path)
    assert {name: found[name].decode() for name in mine} == mine
    assert not found.keys() & old.keys()


NAMES = {
    "cut": "[",
    "empty": "",
    "a number": "3",
    "an object": '{"regions.jsonl": 1}',
    "names of others": '["../notes.txt"]',
    "no names": "[[1]]",
    "nested": "[" * 99999,
    "no text": b"\xff\xfe",
}


@pytest.mark.parametrize("what", NAMES)
@pytest.mark.parametrize("command", ["run", "evaluate"])
def test_damaged_names_of_a_replacement_move_and_remove_nothing(tmp_path, what, command):
    write_results(tmp_path / "out")
    write_tum(tmp_path / "truth.tum", path_of(6))
    fill(tmp_path / "out", {f"{FINISHED}/names.json": NAMES[what], f"{FINISHED}/regions.jsonl": "new"})
    before = everything(tmp_path)
    if command == "evaluate":
        result = invoke("evaluate", tmp_path / "out", "--truth", tmp_path / "truth.tum")
        assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1), result.output
        assert "names.json: is damaged" in result.stderr
    else:
        with pytest.raises(FolderError, match="is damaged"):
            write_results(tmp_path / "out")
    assert everything(tmp_path) == before


@pytest.mark.parametrize("other", ["finished", "finished/notes.txt"])
def test_a_name_that_is_taken_is_told_before_the_work(tmp_path, other):
    write_results(tmp_path)
    fill(tmp_path, {other: "mine"})
    before = everything(tmp_path)
    with pytest.raises(FolderError, match="needs that name"), claimed(tmp_path, "run"):
        pass
    assert everything(tmp_path) == before


CHECK_OUT = {
    "below a file": "file/x",
    "a broken link": "link",
    "too long": "x" * 300,
    "below a device": "/dev/null/x",
}


@pytest.mark.parametrize("what", CHECK_OUT)
def test_data_check_looks_at_its_folder_first(small_world, tmp_path, monkeypatch, what):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr("conformodal.cli.data.open_sequence", None)  # not reached
    result = invoke("data", "check", small_world.folder, "--out", tmp_path / CHECK_OUT[what])
    assert result.exit_code == 2, result.output
    assert "FolderError" in result.stderr
    assert sorted(tmp_path.iterdir()) == before


def test_data_check_goes_on_where_one_was_killed(small_world, tmp_path):
    fill(tmp_path / "out", {".lock": "1", ".metrics.json.1-2.conformodal-part": "{"})
    few = tmp_path / "few"
    for path in [small_world.folder / "camera-intrinsics.txt", *(small_world.folder / "seq-01").glob("*-00000*")]:
        (few / "seq-01").mkdir(parents=True, exist_ok=True)
        shutil.copy(path, few / path.relative_to(small_world.folder))
    assert invoke("data", "check", few, "--out", tmp_path / "out").exit_code == 0
    assert sorted(everything(tmp_path / "out")) == ["figures/plan.svg", "metrics.json", "report.html"]


@pytest.mark.parametrize("moment", ["before the flight", "in the flight", "after it"])
@pytest.mark.parametrize("seed", [0, 4])
def test_a_demo_that_was_killed_starts_again(tmp_path, monkeypatch, moment, seed):
    flights = []

    def fly(folder, *, seed, **_):
        if moment == "before the flight" and not flights:
            flights.append(None)
            raise KeyboardInterrupt
        (folder / "seq-01").mkdir(parents=True)
        (folder / "seq-01" / "seed").write_text(str(seed))
        flights.append(seed)
        if moment == "in the flight" and len(flights) == 1:
            shutil.move(folder / "seq-01", folder / ".seq-01.part")
            raise KeyboardInterrupt

    monkeypatch.setattr("conformodal.cli.demo.write_corridor", fly)
    monkeypatch.setattr("conformodal.cli.demo.train_on", lambda *_, **__: (_ for _ in ()).throw(KeyboardInterrupt))
    monkeypatch.setattr("conformodal.cli.demo.read_sevenscenes", lambda folder: folder)
    for given in (0, seed, seed):
        assert invoke("demo", "--out", tmp_path, "--seed", given).exit_code == 130
    assert (tmp_path / "corridor" / "seq-01" / "seed").read_text() == str(seed)
    assert len(flights) == 1 + (moment != "after it" or seed == 4)
