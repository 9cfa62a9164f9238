"""``conformodal map``: what it prints, its exit codes, and options that contradict each other."""

import json

import pytest

from conformodal.cli.main import _EXTRAS
from conformodal.mapping import settings
from tests.helpers import invoke, refusal

from .conftest import N_FRAMES

pytest.importorskip("pycolmap")


@pytest.mark.slow
def test_a_map_is_described_and_its_unit_said(clip, tmp_path):
    result = invoke("map", clip, "--out", tmp_path / "out", "--json", "--verbose")
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert (printed["command"], printed["trusted"], printed["unit"], printed["written"]) == ("map", True, "units", True)
    lines = result.stderr.splitlines()
    assert any(line.startswith(f"registered: {N_FRAMES} of {N_FRAMES} frames (100 %)") for line in lines)
    assert any(" units; lengths are in map units; --known-length or --positions makes them metres" in e for e in lines)
    assert any(line.startswith("camera: 320x240, f = ") for line in lines)
    assert any(line.startswith("took ") and line.endswith("GB of memory") for line in lines)
    assert "map: good enough to train on" in lines
    record = json.loads((tmp_path / "out" / "map.json").read_text())
    assert record["command"] == "map"
    assert record["videos"] == [str(clip)]
    assert "conformodal" in record["provenance"]


@pytest.mark.slow
def test_a_map_that_is_not_to_be_trusted_has_exit_code_1(clip, elsewhere, tmp_path):
    result = invoke("map", clip, elsewhere, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert "map: not to be trusted" in result.stdout
    assert " does not connect to the others" in result.stdout
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("", "video.mp4: no such file or folder"),
        ("--known-length a.png b.png -1", "positive number of metres, got -1"),
        ("--known-length a.png a.png 2", "needs two images, got a.png twice"),
        ("--known-length a.png b.png", "--known-length"),
        ("--known-length a.png b.png 2 --positions file", "leave out one of them"),
        ("--positions missing.txt", "missing.txt: cannot be read"),
        ("--up sideways", "'sideways' is not one of"),
        ("--keyframes 2", "--keyframes"),
        ("--seed -1", "--seed"),
    ],
)
def test_missing_videos_and_bad_options_are_refused(tmp_path, monkeypatch, options, named):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("a 0 0 0\nb 1 0 0\nc 0 1 0\n")
    assert named in refusal("map", "video.mp4", "--out", "out", *options.split())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_old_pycolmap_error_names_the_pip_line(clip, tmp_path, monkeypatch):
    monkeypatch.setattr(settings, "NEEDED", ("a_function_of_later",))
    assert "pip install 'conformodal[colmap]'" in refusal("map", clip, "--out", tmp_path / "out")
    assert _EXTRAS["map"] == "train"  # of which the rest of the command needs a part
