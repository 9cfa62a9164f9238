"""Folders of results: whose they are, who may write, and what a killed or failed command leaves."""

import errno
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conformodal.core.files import PART, write_whole
from conformodal.geometry import Trajectory
from conformodal.io.folders import FolderError, writing_in
from conformodal.io.pose_files import write_tum
from conformodal.pipeline.results import (
    UNFINISHED,
    ResultsError,
    ResultsWriter,
    lock_output,
    read_region_records,
    read_run,
    read_trajectories,
)
from tests.helpers import contents, fill, invoke, refusal, region_record

# files of a folder, and the commands that may write in it
ANY = {"train", "run", "demo", "evaluate"}
HOLDS = {
    "a model and its metrics": ({"model.json": "{}", "metrics.json": '{"command": "train"}'}, {"train"}),
    "a run": ({"regions.jsonl": "", "metrics.json": '{"command": "run"}'}, {"run"}),
    "a killed run": ({"regions.jsonl.part": ""}, ANY),
    "a demo": ({"corridor/x": "", "regions.jsonl": "", "metrics.json": '{"command": "demo"}'}, {"demo"}),
    "a reproduction": ({"metrics.json": '{"command": "reproduce table1"}'}, set()),
    "an evaluation": ({"metrics.json": '{"command": "evaluate"}'}, {"evaluate"}),
    "metrics of something else": ({"metrics.json": "[1]"}, set()),
    "other files": ({"notes.txt": "mine"}, ANY),
    "nothing": ({}, ANY),
    # files of the names that a command writes, where it has not written any
    "a report": ({"report.html": "mine"}, {"train", "evaluate"}),
    "a folder called model": ({"model/model.json": "mine"}, ANY - {"demo"}),
}


@pytest.mark.parametrize("what", HOLDS)
def test_a_folder_belongs_to_one_command(tmp_path, what):
    files, allowed = HOLDS[what]
    fill(tmp_path, files)
    before = contents(tmp_path)
    for command in ANY:
        if command in allowed:
            with lock_output(tmp_path, command):
                assert (tmp_path / ".lock").read_text().strip() == str(os.getpid())
        else:
            with pytest.raises(FolderError, match=str(tmp_path)), lock_output(tmp_path, command):
                pass
        assert contents(tmp_path) == before


UNUSABLE = ["file", "file/x/y", "link", "a\0b", "x" * 300]


@pytest.mark.parametrize("name", UNUSABLE, ids=range(len(UNUSABLE)))
def test_unwritable_folders_are_refused(tmp_path, name):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(FolderError), lock_output(tmp_path / name, "run"):
        pass
    assert sorted(tmp_path.iterdir()) == before


HOLD = "import sys; from pathlib import Path; from conformodal.io.folders import writing_in\n"
HOLD += "with writing_in(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"


def test_a_folder_in_use_is_refused_until_its_process_dies(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout.readline() == b"held\n"
        for command in ("train", "run", "demo"):
            with pytest.raises(FolderError, match=f"{tmp_path}.*{other.pid}"), lock_output(tmp_path, command):
                pass
        other.kill()
    (tmp_path / f".x.1{PART}").write_text("half a file")
    with writing_in(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch):
    write_whole(tmp_path / "x", "old")
    write = Path.write_bytes

    def full(path, content):
        write(path, content[:1])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        write_whole(tmp_path / "x", "new")
    assert contents(tmp_path) == {"x": b"old"}


def path_of(n, shift=0.0, start=0.0):
    times = start + 0.1 * np.arange(n)
    places = np.column_stack((np.cos(times), np.sin(times), 0 * times)) + shift
    return Trajectory(times, places, np.tile([1.0, 0, 0, 0], (n, 1)))


def write_results(folder, n=6, shift=0.0, truth=True, after=None):
    """A made-up run; `after` frames it breaks off."""
    path = path_of(n, shift)
    with ResultsWriter(folder) as writer:
        for i in range(n):
            if i == after:
                raise OSError(errno.ENOSPC, "No space left on device")
            parts = [np.array([[v - 0.2, v + 0.2]]) for v in (*path.positions_xyz[i], 1.0, 0.0, 0.0, 0.0)]
            writer.region(region_record(f"frame-{i}", float(path.timestamps_s[i]), parts))
            writer.poses("online", path[i : i + 1])
        if n == after:
            raise KeyboardInterrupt
        writer.poses("smoothed", path)
        if truth:
            writer.truth(path)
    done = {"command": "run", "configuration": {}, "seed": 0, "sign_reference_quat_wxyz": [1, 0, 0, 0]}
    writer.publish({**done, "results": writer.digests})


@pytest.mark.parametrize("after", [0, 3, 6])
def test_earlier_results_stay_where_the_next_run_breaks_off(tmp_path, after):
    write_results(tmp_path)
    mine = {"evaluation/notes.txt": "mine", "methods/notes.txt": "mine", "notes.txt": "mine"}
    made = {"evaluation/metrics.json": '{"command": "evaluate"}', "methods/old.tum": "", "evaluation/errors.csv": ""}
    fill(tmp_path, mine | made)
    before = contents(tmp_path)
    with pytest.raises((OSError, KeyboardInterrupt)):
        write_results(tmp_path, shift=1.0, after=after)
    left = contents(tmp_path)
    assert {k: v for k, v in left.items() if not k.endswith(UNFINISHED)} == before
    assert left.get(f"regions.jsonl{UNFINISHED}", b"").count(b"\n") == after
    write_results(tmp_path, shift=1.0, truth=False)
    after_all = contents(tmp_path)
    assert {name: after_all[name].decode() for name in mine} == mine
    assert not after_all.keys() & {*made, "truth.tum"}
    assert not [name for name in after_all if name.endswith(UNFINISHED)]
    assert read_trajectories(tmp_path)["smoothed"].positions_xyz[0, 0] == pytest.approx(2)


@pytest.mark.parametrize("step", range(8))
def test_a_run_killed_while_publishing_is_refused(tmp_path, monkeypatch, step):
    """Before the first replacement the earlier run stands; a mixture is refused."""
    write_results(tmp_path)
    fill(tmp_path, {"methods/old.tum": (tmp_path / "methods" / "online.tum").read_text()})
    before, left = contents(tmp_path), iter(range(step))

    def killed(change):
        """A change of a file of a run, before which the run may be killed."""

        def changed(self, *how, **options):
            if self.suffix != PART and next(left, None) is None:
                raise KeyboardInterrupt
            return change(self, *how, **options)

        return changed

    writer, publish = ResultsWriter, ResultsWriter.publish

    def publish_killed(its, metrics):
        with monkeypatch.context() as patch:
            patch.setattr(Path, "replace", killed(Path.replace))
            patch.setattr(Path, "unlink", killed(Path.unlink))
            publish(its, metrics)

    monkeypatch.setattr(writer, "publish", publish_killed)
    try:
        write_results(tmp_path, shift=1.0, truth=False)
    except KeyboardInterrupt:
        if step == 0:
            assert {k: v for k, v in contents(tmp_path).items() if not k.endswith(UNFINISHED)} == before
            assert read_run(tmp_path).answer.positions_xyz[0, 0] == pytest.approx(1)
        else:
            with pytest.raises(ResultsError, match="Run it again"):
                read_run(tmp_path)
    else:  # three files, two that are old, the page that is not there, and the metrics
        assert step == 7
        assert read_run(tmp_path).answer.positions_xyz[0, 0] == pytest.approx(2)
        assert not contents(tmp_path).keys() & {"truth.tum", "methods/old.tum"}


def drop(*names):
    return lambda f: [(f / name).unlink() for name in names]


def cut(name, n):
    return lambda f: (f / name).write_bytes((f / name).read_bytes()[:-n])


def says(**changes):
    def change(folder):
        path = folder / "metrics.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


# what is changed in a folder of results, and the words of the refusal
CHANGED = {
    "killed": (
        lambda f: [(f / "regions.jsonl").rename(f / "regions.jsonl.part"), (f / "metrics.json").unlink()],
        "regions.jsonl.part. Run it again",
    ),
    "no metrics": (drop("metrics.json"), "metrics.json"),
    "signs are three": (says(sign_reference_quat_wxyz=[1, 0, 0]), "not four numbers"),
    "a method has other times": (
        lambda f: write_tum(f / "methods" / "online.tum", replace(path_of(6), timestamps_s=9 + np.arange(6.0))),
        "poses of online have other times",
    ),
    "regions are others": (cut("regions.jsonl", 400), "regions.jsonl"),
    "the answer is another": (cut("trajectory.tum", 90), "trajectory.tum: is not the file"),
}


@pytest.mark.parametrize("what", CHANGED)
def test_results_that_do_not_belong_together_are_not_evaluated(tmp_path, what):
    change, expected = CHANGED[what]
    write_results(tmp_path / "out")
    write_tum(tmp_path / "truth.tum", path_of(6))
    evaluated = invoke("evaluate", tmp_path / "out", "--truth", tmp_path / "truth.tum")
    assert evaluated.exit_code == 0, evaluated.output
    coverage = json.loads((tmp_path / "out" / "evaluation" / "metrics.json").read_text())["coverage"]
    assert coverage["joint_coverage"] == 1.0
    change(tmp_path / "out")
    before = contents(tmp_path / "out")
    assert expected in refusal("evaluate", tmp_path / "out", "--truth", tmp_path / "truth.tum")
    assert contents(tmp_path / "out") == before


WHOLE = {t: [[0, 1]] for t in ("x", "y", "z", "q_w", "q_x", "q_y", "q_z")}
RECORD = {"timestamp_s": 1.0, "frame": "f", "motion": "first", "reliable": True, "intervals": WHOLE}
RECORD |= {"evidence": "global", "places": None, "path_places": None}
LINES = {
    "no intervals": {k: v for k, v in RECORD.items() if k != "intervals"},
    "no reliability": {k: v for k, v in RECORD.items() if k != "reliable"},
    "intervals of others": RECORD | {"intervals": {"x": []}},
    "a name that is a number": RECORD | {"frame": 3},
    **{
        f"x is {x}": RECORD | {"intervals": WHOLE | {"x": x}} for x in ([[0, 1, 2]], [["0", "1"]], [1, 2], [[0, 1e999]])
    },
}


@pytest.mark.parametrize("what", LINES)
def test_damaged_records_are_named(tmp_path, what):
    path = tmp_path / "regions.jsonl"
    path.write_text(json.dumps(RECORD) + "\n" + json.dumps(LINES[what]) + "\n")
    with pytest.raises(ResultsError, match="line 2"):
        read_region_records(path)


@pytest.fixture(scope="module")
def world(small_world, tmp_path_factory):
    """A copy of the small world, with a source whose frames cannot be read, results, and a folder with a truth."""
    root = tmp_path_factory.mktemp("world")
    shutil.copytree(small_world.model, root / "m")
    shutil.copytree(small_world.folder, root / "data")
    for name in ("camera-intrinsics.txt", "frame-rate.txt"):
        (root / "bad").mkdir(exist_ok=True)
        shutil.copy(small_world.folder / name, root / "bad")
    for path in sorted((small_world.folder / "seq-01").glob("*.png"))[:2]:
        (root / "bad" / path.name).write_bytes(path.read_bytes()[:200])
    write_results(root / "out")
    fill(root, {"mine/truth.tum": "mine"})
    return root


REFUSED = [
    "run m data --out m", "run m data --out data", "run m data --out mine", "train data --out data",
    "run m data --out data/seq-01/out",    "train data --out data/out",
    "run m bad --out out --format images",
]  # fmt: skip


@pytest.mark.parametrize("command", REFUSED)
def test_a_command_that_is_refused_changes_nothing(world, monkeypatch, command):
    monkeypatch.chdir(world)
    before = contents(world)
    result = invoke(*command.split())
    assert result.exit_code == 2, result.output
    assert [line[:7] for line in result.stderr.splitlines() if "error" in line] == ["error: "]
    assert "Traceback" not in result.output
    after = contents(world)
    assert {name: after.get(name) for name in before} == before
    assert all(name.endswith(".log") for name in after.keys() - before)
