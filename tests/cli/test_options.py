"""Options out of range, contradictions, and what the system refuses: an exit code, and the option or file is named."""

import errno
import signal

import pytest
import typer
from typer.testing import CliRunner

from conformodal.cli import console
from conformodal.conformal import ConformodalError
from tests.helpers import refusal
from tests.io.streams.test_streams import video as write_video

COMMANDS = {
    "train": "train data --out out",
    "run": "run model source.mcap --out out",
    "demo": "demo --out out",
    "convert": "data convert data --out out",
}
# command, options, and what the message names
REFUSED = [
    *(("train", f"--{name}={value}", name) for name in ("bins", "epochs") for value in (0, 10**7, "x")),
    *(("train", f"--test={value}", "test must be a finite number") for value in (0, 1, "nan")),
    *(("train", f"--alpha={value}", "alpha must") for value in (0, 1, 90, "nan")),
    *((command, f"--seed={value}", "seed") for command in ("train", "demo") for value in (-1, 0.5)),
    ("train", "--test=0.9", "must leave something to train on"),
    ("train", "--network=resnet", "resnet"),
    ("train", "--score=best", "score must be"),
    ("train", "--joint=bonferroni", "joint must be"),
    ("train", "--sources=head,stars", "stars"),
    ("train", "--cache=file", "file: cannot be written"),
    ("train", "--out=file", "file: cannot be written"),
    ("train", "", "data: no such file or folder"),
    ("train", "--split=blocks --test=other", "--test"),
    ("train", "--address=host:6379", "--address needs --engine ray, got --engine local"),
    ("train", "--method=paper --score=hpd", "no settings {'score'"),
    ("train", "--method=paper --joint=max", "no settings {'joint'"),
    ("run", "", "no saved model there"),
    ("run", "--limit=0", "limit"),
    ("run", "--save=.", "--save"),
    ("run", "--save=file", "--save"),
    ("run", "--save=source.mcap", "source.mcap"),
    ("run", "--save-images", "--save-images"),
    ("run", "--save=a.mcap --save=b.rrd", "given twice"),
    ("run", "--view --view", "given twice"),
    ("train", "--splitt=blocks", "--split"),
    ("convert", "--to=kitti", "must be tum"),
    *(("convert", f"--axes={value}", "axes must say") for value in ("x", "flf", "forward-back-up", "fluu", "")),
    *(("convert", f"--world-axes={value}", "world axes must be") for value in ("x,y", "x,y,y", "yx-z", "x,y,w", "")),
    ("run", "--save=v.rrd --save-images", "--save-images"),
]


@pytest.mark.parametrize(("command", "options", "named"), REFUSED)
def test_what_cannot_be_is_refused_before_the_work(tmp_path, monkeypatch, command, options, named):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    words = COMMANDS[command].replace("--out out", "") if "--out" in options else COMMANDS[command]
    cache = ["--cache", "cache"] if command == "train" and "--cache" not in options else []
    assert named in refusal(*words.split(), *cache, *options.split())
    assert {p.name for p in tmp_path.iterdir()} <= {"file", "cache"}
    assert (tmp_path / "file").read_text() == "mine"


# command, exit code and what is named; places stand for what there is
CONTRADICTIONS = [
    ("run MODEL DATA --topic /image", "--topic"),
    ("run MODEL VIDEO --part test", "video"),
    ("data convert DATA --topic /image", "--topic"),
    ("data convert DATA --camera DATA", "--camera"),
    ("data convert VIDEO --camera DATA --axes flu", "--axes"),
]


@pytest.mark.parametrize(("command", "named"), CONTRADICTIONS)
def test_options_that_would_change_nothing_are_refused(small_world, tmp_path, command, named):
    places = {"MODEL": small_world.model, "DATA": small_world.folder, "VIDEO": write_video(tmp_path / "video.avi")}
    assert named in refusal(*(places.get(word, word) for word in command.split()), "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def ended(error):
    """The result of a command that fails so."""
    small = typer.Typer()

    @small.command()
    @console.report_errors()
    def command() -> None:
        raise error

    return CliRunner().invoke(small, [])


ENDS = [
    (ConformodalError("x: y"), 2, "error: x: y"),
    (OSError(errno.ENOSPC, "No space left on device", "/a/b"), 4, "/a/b: No space"),
    (OSError(errno.EROFS, "Read-only file system", b"/a"), 4, "/a: Read-only"),
    (OSError(errno.EIO, "Input/output error"), 4, "Input/output error"),
    (MemoryError(), 4, "not enough memory"),
    (RuntimeError("DefaultCPUAllocator: can't allocate: you tried not enough memory"), 4, "not enough memory"),
    (KeyError("x"), 70, "KeyError: 'x' (internal error"),
    (ValueError("a\nb\x1b[31m"), 70, "a\\nb\\x1b[31m"),
    (KeyboardInterrupt(), 130, "interrupted"),
]


@pytest.mark.parametrize(("error", "code", "named"), ENDS)
def test_every_end_is_one_line_and_a_code(monkeypatch, error, code, named):
    monkeypatch.delenv(console.SHOW_ALL, raising=False)
    result = ended(error)
    assert result.exit_code == code
    (line,) = result.stderr.splitlines()
    assert named in line


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_masked_by_an_error_is_reported(number):
    small = typer.Typer()

    @small.command()
    @console.report_errors()
    def command() -> None:
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None

    result = CliRunner().invoke(small, [])
    assert result.exit_code == 128 + number
    assert result.stderr.startswith("error: interrupted")


def test_a_fault_of_the_program_can_be_shown_in_full(monkeypatch):
    monkeypatch.setenv(console.SHOW_ALL, "1")
    assert isinstance(ended(KeyError("x")).exception, KeyError)
