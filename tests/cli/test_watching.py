"""Views, recordings and threads of a run are closed, whatever ends it."""

import pytest

from conformodal.cli import run


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
