"""Views, recordings and threads of a run are closed, whatever ends it."""

import pytest
from typer.testing import CliRunner

from conformodal.cli import run
from conformodal.cli.main import app


class Recorder:
    """Stands in for a recording."""

    def __init__(self, *arguments, **options):
        self.open = True
        opened.append(self)

    def log(self, *frame):
        pass

    def close(self):
        self.open = False


opened: list[Recorder] = []


@pytest.fixture(autouse=True)
def recorders(monkeypatch):
    opened.clear()
    monkeypatch.setattr("conformodal.ros.bag.BagWriter", Recorder)
    monkeypatch.setattr("conformodal.report.live.LiveView", Recorder)


class NoScreen(Recorder):
    def __init__(self, *arguments, **options):
        raise OSError("no screen")


class Broken(Recorder):
    def close(self):
        raise OSError("gone")


@pytest.mark.parametrize(("view", "still_open"), [(NoScreen, [False]), (Broken, [False, True])])
def test_a_view_that_fails_leaves_no_recording_open(monkeypatch, tmp_path, view, still_open):
    monkeypatch.setattr("conformodal.report.live.LiveView", view)
    sinks = run.frame_sinks("a", 0.1, view=True, save=tmp_path / "a.mcap", images=False)
    with pytest.raises(OSError, match=r"^(no screen|gone)$"), sinks:
        pass
    assert [recorder.open for recorder in opened] == still_open


@pytest.mark.slow
@pytest.mark.parametrize("broken", ["answering.ResultsWriter", "answering.write_metrics", "run.progress_bars"])
def test_a_run_that_cannot_write_closes_what_it_has_opened(small_world, tmp_path, monkeypatch, broken):
    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(f"conformodal.cli.{broken}", full)
    arguments = ["run", small_world.model, small_world.folder, "--out", tmp_path / "out", "--save", tmp_path / "a.mcap"]
    result = CliRunner().invoke(app, [str(a) for a in [*arguments, "--limit", 3, "--view"]])
    assert result.exit_code != 0
    assert [recorder.open for recorder in opened] == [False, False]
