"""Options out of range, contradictions, and what the system refuses: one line and an exit code, before any work."""

import errno
import os
import signal
import typing
from functools import partial
from math import inf, isfinite, nan

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from conformodal.cli import failures
from conformodal.cli.console import report_errors
from conformodal.cli.main import app
from conformodal.cli.options import range_of
from conformodal.conformal import ConformodalError, QuantileBins
from conformodal.core.ranges import RANGES, Range
from conformodal.features.settings import TrainingConfig
from conformodal.io import make_split
from conformodal.pipeline.config import ModelConfig
from tests.helpers import invoke
from tests.io.streams.test_streams import video as write_video

SHARE = Range(0, 1, low_open=True, high_open=True)


def line_of(result, code=2):
    assert result.exit_code == code, (result.output, result.exception)
    assert "Traceback" not in result.output
    lines = result.stderr.splitlines()
    assert len(lines) == 1, lines
    return lines[0]


COMMANDS = {
    "train": ["train", "data", "--out", "out"],
    "run": ["run", "model", "source.mcap", "--out", "out"],
    "calibrate": ["calibrate", "model", "data"],
    "demo": ["demo", "--out", "out"],
}


def verbs():
    group = typer.main.get_command(app)
    return {name: group.get_command(None, name).loaded() for name in group.list_commands(None)}


def outside(allowed):
    """Values on both sides of a range, and what is not a finite number."""
    ends = [allowed.low] * allowed.low_open + [allowed.high] * allowed.high_open
    far = [allowed.low - 1, allowed.high + 1, 10.0 * allowed.high]
    return [*ends, *(v for v in far if isfinite(v))] + ([] if allowed.whole else [nan, inf, -inf])


def inside(allowed):
    step = 1e-3 if not allowed.whole else 0
    ends = allowed.low + step * allowed.low_open, allowed.high - step * allowed.high_open
    return [int(v) if allowed.whole else v for v in ends if isfinite(v)]


NUMBERS = [
    (start, name, SHARE if name == "alpha" else range_of(name))
    for command, start in COMMANDS.items()
    for name in [p.name for p in verbs()[command].params]
    if name == "alpha" or range_of(name) is not None
]


@pytest.mark.parametrize(("start", "name", "allowed"), NUMBERS)
def test_numbers_out_of_range_are_refused_before_anything_is_read(tmp_path, monkeypatch, start, name, allowed):
    monkeypatch.chdir(tmp_path)
    option = f"--{name.replace('_', '-')}"
    for value in outside(allowed):
        text = f"{value:.0f}" if isfinite(value) and value == int(value) else str(value)
        said = line_of(invoke(*start, f"{option}={text}"))
        assert "OptionError" in said
        assert option in said
    assert not list(tmp_path.iterdir())


SPLIT = partial(make_split, np.repeat([0, 1, 2], 50), "blocks")
DOORS = {
    QuantileBins: ["n_bins"],
    ModelConfig: ["n_bins", "sigma_bins", "novelty_level", "test", "seed"],
    SPLIT: ["test", "calibration", "used", "seed", "n_blocks"],
    TrainingConfig: ["epochs", "batch_size", "learning_rate", "dropout", "seed"],
}


@pytest.mark.parametrize(("name", "door"), [(name, door) for door, names in DOORS.items() for name in names])
def test_python_has_the_ranges_of_the_command_line(name, door):
    for value in outside(RANGES[name]):
        with pytest.raises(ConformodalError, match=name):
            door(**{name: value})
    for value in inside(RANGES[name]) if not RANGES[name].high_open and door is not SPLIT else []:
        door(**{name: value})


@pytest.mark.parametrize("option", ["bins", "sigma", "dropout", "epochs", "seed"])
def test_the_ends_of_a_range_are_accepted(tmp_path, monkeypatch, option):
    monkeypatch.chdir(tmp_path)
    for value in inside(range_of(option)):
        given = [f"--{option.replace('_', '-')}={value}"]
        assert "data" in line_of(invoke("train", "data", "--out", "out", *given)).lower()


def test_every_number_has_a_range():
    for command, verb in verbs().items():
        hints = typing.get_type_hints(getattr(verb.callback, "__wrapped__", verb.callback))
        for name, hint in hints.items():
            if {int, float} & {hint, *typing.get_args(hint)}:
                assert range_of(name) or name in ("alpha", "time_offset"), f"{command} {name}"


WRONG = {
    "a network": (["train", "--network", "resnet"], "backbone must be one of"),
    "a device": (["train", "--device", "tpu"], "device must be"),
    "a score": (["train", "--score", "best"], "score"),
    "a joint": (["train", "--joint", "all"], "joint"),
    "a source": (["train", "--sources", "head,stars"], "pose source must be one of"),
    "shares": (["train", "--test", "0.5", "--calibration-share", "0.5"], "leave something to train on"),
    "used": (["train", "--used", "0.16"], "--used must be more than"),
    "a cache that is a file": (["train", "--cache", "file"], "--cache must be a folder"),
    "an out that is a file": (["train", "--out", "file"], "not a folder"),
    "no data": (["train"], "data"),
    "a method": (["calibrate", "--method", "best"], "--method must be one of"),
    "no model": (["calibrate"], "no saved model"),
    "run: no model": (["run"], "no saved model"),
    "run: a recording that is a folder": (["run", "--save", "."], "--save must be a file"),
    "run: images alone": (["run", "--save-images"], "--save-images needs --save FILE.mcap, got no --save"),
    "run: images for Rerun": (["run", "--save", "v.rrd", "--save-images"], "--save FILE.mcap, got v.rrd"),
    "run: over the source": (["run", "--save", "source.mcap"], "--save would write over the source"),
    "run: a recording over a picture": (["run", "--save", "file"], "--save must name a file .rrd"),
    **{
        f"the paper has no {options[0]}": (["train", "--method", "paper", *options], "the paper's system has no")
        # our own values, given all the same
        for options in (("--score", "hpd"), ("--sigma", "0.7"), ("--novelty-level", "0.015"))
    },
}


@pytest.mark.parametrize("what", WRONG)
def test_what_cannot_be_is_refused_before_the_work(tmp_path, monkeypatch, what):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    (command, *options), said = WRONG[what]
    start = COMMANDS[command]
    if "--out" in options and "--out" in start:
        start = start[: start.index("--out")]
    assert said in line_of(
        invoke(*start, "--cache", "cache", *options) if command == "train" else invoke(*start, *options)
    )
    assert {p.name for p in tmp_path.iterdir()} <= {"file", "cache"}
    assert (tmp_path / "file").read_text() == "mine"


def ended(error, **kwargs):
    """The result of a command that fails so."""
    small = typer.Typer()

    @small.command()
    @report_errors
    def command() -> None:
        raise error

    return CliRunner().invoke(small, [], **kwargs)


ENDS = {
    "our error": (ConformodalError("x: y"), 2, "error: ConformodalError: x: y"),
    "full disk": (OSError(errno.ENOSPC, "No space left on device", "/a/b"), 4, "refused: /a/b: No space"),
    "permission": (PermissionError(errno.EACCES, "Permission denied", "/a"), 4, "/a: Permission denied"),
    "read-only": (OSError(errno.EROFS, "Read-only file system", b"/a"), 4, "/a: Read-only"),
    "a device": (OSError(errno.EIO, "Input/output error"), 4, "Input/output error"),
    "memory": (MemoryError(), 4, "not enough memory"),
    "torch's memory": (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 4, "not enough memory"),
    "our own fault": (KeyError("x"), 70, "KeyError: 'x' (a fault of this program, cli/console.py"),
    "recursion": (RecursionError("too deep"), 70, "RecursionError"),
    "several lines": (ValueError("a\nb\x1b[31m"), 70, "a\\nb\\x1b[31m"),
    "Ctrl-C": (KeyboardInterrupt(), 130, "interrupted"),
}


@pytest.mark.parametrize("what", ENDS)
def test_every_end_is_one_line_and_a_code(what, monkeypatch):
    monkeypatch.delenv(failures.SHOW_ALL, raising=False)
    error, code, said = ENDS[what]
    assert said in line_of(ended(error), code)


def test_who_wants_to_see_all_sees_all(monkeypatch):
    monkeypatch.setenv(failures.SHOW_ALL, "1")
    assert isinstance(ended(KeyError("x")).exception, KeyError)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_signals_are_treated_alike_and_handlers_come_back(name):
    number = getattr(signal, name)
    outside = signal.signal(number, signal.default_int_handler)  # under nohup it would stay ignored

    def send(times, *, gently):
        with failures.stopping(gently=gently) as came:
            came_of.append(came)
            for _ in range(times):
                os.kill(os.getpid(), number)

    came_of = []
    try:
        with pytest.raises(KeyboardInterrupt):
            send(1, gently=False)
        send(1, gently=True)
        with pytest.raises(KeyboardInterrupt):
            send(2, gently=True)
        assert [failures.stop_code(came) for came in came_of] == [128 + number] * 3
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, outside)


def test_a_signal_that_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with failures.stopping() as came:
            os.kill(os.getpid(), signal.SIGHUP)
        assert came == []
    finally:
        signal.signal(signal.SIGHUP, before)


def test_options_are_checked_of_every_command():
    for verb in verbs().values():
        if verb.callback is not None and not hasattr(verb, "commands"):
            assert hasattr(verb.callback, "__wrapped__")  # by report_errors


SAY_NOTHING = {
    "a topic of a folder": (("run", "MODEL", "DATA", "--topic", "/image"), "--topic is for ROS recordings"),
    "convert: a topic": (("data", "convert", "DATA", "--topic", "/image"), "--topic is for ROS recordings"),
    "convert: a camera": (("data", "convert", "DATA", "--camera", "DATA"), "--camera is for sources without calibr"),
    "a video has no part": (("run", "MODEL", "VIDEO", "--part", "test"), "only a data set has a test part"),
    "export: data alone": (("export", "MODEL", "--data", "."), "--quantise"),
    "export: no data": (("export", "MODEL", "--quantise", "int8"), "--quantise"),
    "export: no such form": (("export", "MODEL", "--quantise", "int4"), "--quantise"),
}


@pytest.mark.parametrize("what", SAY_NOTHING)
def test_options_that_would_change_nothing_are_refused(small_world, tmp_path, what):
    arguments, said = SAY_NOTHING[what]
    places = {"MODEL": small_world.model, "DATA": small_world.folder, "VIDEO": write_video(tmp_path / "v.avi")}
    assert said in line_of(invoke(*(places.get(a, a) for a in arguments), "--out", tmp_path / "out"))
    assert not (tmp_path / "out").exists()
