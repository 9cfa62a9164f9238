import json
from dataclasses import dataclass

import pytest

from conformodal.experiments import ExperimentError, run_tasks


@dataclass(frozen=True)
class Square:
    number: int
    version: int = 1

    @property
    def key(self):
        return f"square-{self.number}"

    @property
    def settings(self):
        return {"number": self.number, "version": self.version, "shape": (1, 2)}


class Counting:
    def __init__(self, stop_at=None):
        self.done, self.stop_at = [], stop_at

    def __call__(self, task):
        if task.number == self.stop_at:
            raise KeyboardInterrupt
        self.done.append(task.number)
        return {"square": task.number**2}


def test_results_come_in_order_and_are_kept(tmp_path):
    tasks = [Square(k) for k in (3, 1, 2)]
    work, seen = Counting(), []
    results = run_tasks(tasks, work, tmp_path / "new", lambda *a: seen.append(a))
    assert [r["square"] for r in results] == [9, 1, 4]
    assert seen == [("tasks", k, 3) for k in range(4)]
    again = Counting()
    assert run_tasks(tasks, again, tmp_path / "new") == results
    assert again.done == []


def test_a_stopped_run_goes_on_where_it_was(tmp_path):
    tasks = [Square(k) for k in range(5)]
    with pytest.raises(KeyboardInterrupt):
        run_tasks(tasks, Counting(stop_at=3), tmp_path)
    rest = Counting()
    assert [r["square"] for r in run_tasks(tasks, rest, tmp_path)] == [0, 1, 4, 9, 16]
    assert rest.done == [3, 4]


def test_results_of_other_settings_or_damaged_ones_are_worked_out_again(tmp_path):
    run_tasks([Square(k) for k in range(4)], Counting(), tmp_path)
    (tmp_path / "square-1.json").write_text("{")
    (tmp_path / "square-2.json").write_text("[]")
    record = json.loads((tmp_path / "square-3.json").read_text())
    (tmp_path / "square-3.json").write_text(json.dumps({**record, "result": 5}))
    work = Counting()
    run_tasks([Square(0), Square(1), Square(2), Square(3)], work, tmp_path)
    assert work.done == [1, 2, 3]
    work = Counting()
    run_tasks([Square(0, version=2)], work, tmp_path)
    assert work.done == [0]


def test_tasks_that_share_a_key_are_refused(tmp_path):
    with pytest.raises(ExperimentError, match="square-1"):
        run_tasks([Square(1), Square(1, version=2)], Counting(), tmp_path)
