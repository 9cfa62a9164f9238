"""What all commands share on the terminal: lines, progress, and how errors and signals end a command."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, cast

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TimeElapsedColumn, TimeRemainingColumn
from typer.core import TyperCommand, TyperGroup

from conformodal.core.errors import ConformodalError
from conformodal.core.progress import StageProgress

# 0 all went well; 1 `data check` found something; 128 + n stopped by signal n, as shells say it
BAD_INPUT, BROKE_OFF, REFUSED, OWN_FAULT = 2, 3, 4, 70
SHOW_ALL = "CONFORMODAL_DEBUG"  # set in the environment, it shows the traceback of an error of this program
# click's ClickException, of which newer versions of Typer have a copy
_USAGE_ERROR = cast("type[Exception]", typer.BadParameter.__mro__[2])
_LOG, _REPORT_EVERY_S = "conformodal.log", 10.0
_STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

OUTPUT_PANEL = "Output"
Quiet = Annotated[bool, typer.Option("--quiet", help="Print warnings alone.", rich_help_panel=OUTPUT_PANEL)]
Verbose = Annotated[bool, typer.Option("--verbose", help="Print all findings.", rich_help_panel=OUTPUT_PANEL)]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON; lines go to stderr.", rich_help_panel=OUTPUT_PANEL)]


class OptionError(ConformodalError):
    """An option that cannot be used, or contradicts another."""


@dataclass
class _Terminal:
    """How the command under way prints."""

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    lines: list[str] = field(default_factory=list)  # of this command, shown or not
    log: Path | None = None  # gets these lines

    def begin(self, params: dict[str, Any]) -> None:
        """Forget the command before, and take the options of a new one."""
        self.quiet, self.verbose, self.as_json = (bool(params.get(name)) for name in ("quiet", "verbose", "as_json"))
        self.lines, self.log = [], None

    def write(self, line: str) -> None:
        """Keep a line for the log, or append it; a log that cannot be written stops no work."""
        if self.log is None:
            self.lines.append(line)
        else:
            with suppress(OSError), self.log.open("a", encoding="utf-8") as file:
                file.write(f"{line}\n")

    def log_to(self, path: Path) -> None:
        """Begin a log, with the lines until now."""
        with suppress(OSError):
            path.write_text("".join(f"{line}\n" for line in self.lines), encoding="utf-8")
            self.log = path


_terminal = _Terminal()


class ShortHelp:
    """Commands and groups whose help has no type beside a flag, and spaces between choices, for lines to break at."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The parameters, ``--help`` among them."""
        params = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            if getattr(param, "is_flag", False):
                param.metavar = ""
            elif isinstance(param.default, StrEnum):
                param.metavar = " | ".join(type(param.default))
        return params  # type: ignore[no-any-return]


class Group(ShortHelp, TyperGroup):
    """A group of commands."""


class Command(ShortHelp, TyperCommand):
    """A command that refuses an option given twice, unless it is repeatable, and heeds those of the terminal."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, after a look at how often each is given."""
        order: list[Any] = list(self.make_parser(ctx).parse_args(args=list(args))[2])
        for param in order:
            if order.count(param) > 1 and not getattr(param, "multiple", False):
                raise typer.BadParameter("is given twice, but takes one value", ctx=ctx, param=param)
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command with its options for the terminal."""
        _terminal.begin(ctx.params)
        return super().invoke(ctx)


def plain(text: str) -> str:
    """Text on one line that a terminal shows as it is: control characters and undecodable bytes with backslashes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def report_line(text: str, *, bold: bool = False, detail: bool = False) -> None:
    """One line of the result, however long; in bold, what a user must see; details are for ``--verbose``.

    Where the reader closes the pipe, as ``head`` does, the work goes on and nothing more is printed.
    """
    line = plain(text)
    _terminal.write(line)
    if (_terminal.quiet and not bold) or (detail and not _terminal.verbose):
        return
    try:
        typer.echo(typer.style(line, bold=True) if bold else line, err=_terminal.as_json)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def report_error(text: str) -> None:
    """One line on stderr."""
    _terminal.write(f"error: {plain(text)}")
    typer.echo(typer.style("error: ", fg="red", bold=True) + plain(text), err=True)


def print_json(metrics: dict[str, Any]) -> None:
    """The metrics on stdout, if they are asked for."""
    if _terminal.as_json:
        typer.echo(json.dumps(metrics, indent=1))


def print_where(folder: Path) -> None:
    """The last lines: where the log and the results are."""
    if _terminal.log is not None:
        report_line(f"log: {_terminal.log.resolve()}")
    report_line(f"results: {folder.resolve()}")


@contextmanager
def warning_lines(category: type[Warning], report: Callable[[str], None] = report_line) -> Iterator[None]:
    """Report each warning of a category as a line; others stay warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", category)
        show = warnings.showwarning

        def report_or_show(message: Warning | str, kind: type[Warning], *where: Any) -> None:
            report(str(message)) if issubclass(kind, category) else show(message, kind, *where)

        warnings.showwarning = report_or_show  # type: ignore[assignment]
        yield


@contextmanager
def progress_bars(folder: Path | None = None) -> Iterator[StageProgress]:
    """One bar per stage; without a terminal, and in the log of a folder, the stage under way every ten seconds."""
    columns = ("{task.description:>12}", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    reported_at, console = time.monotonic(), Console(stderr=True)
    with Progress(*columns, console=console, disable=_terminal.quiet or not console.is_terminal) as progress:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            nonlocal reported_at
            if folder is not None and _terminal.log is None:  # what is refused before any work leaves the log before
                _terminal.log_to(folder / _LOG)
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage)
            progress.update(tasks[stage], completed=done, total=total or None)
            if time.monotonic() > reported_at + _REPORT_EVERY_S:
                reported_at = time.monotonic()
                line = f"{time.strftime('%Y-%m-%d %H:%M:%S')} {stage} {done}/{total or '?'}"
                _terminal.write(line)
                if not (_terminal.quiet or console.is_terminal):
                    typer.echo(line, err=True)

        yield report


@contextmanager
def report_errors() -> Iterator[None]:
    """End what goes wrong in a command with one line on stderr and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    with stopping() as signals:
        try:
            yield
        except (typer.Exit, typer.Abort):
            raise
        except _USAGE_ERROR as exc:
            exc.message = exc.message.removeprefix("Value error, ")  # type: ignore[attr-defined]
            raise
        except (KeyboardInterrupt, Exception) as exc:
            # a library may answer the interrupt with an error of its own, as compiled modules do while they load
            if signals or isinstance(exc, KeyboardInterrupt):
                report_error("interrupted; what was computed until now is kept")
                raise typer.Exit(stop_code(signals)) from None
            text, code = _explained(exc)
            if code == OWN_FAULT and os.environ.get(SHOW_ALL):
                raise
            report_error(text)
            raise typer.Exit(code) from exc


def _explained(error: Exception) -> tuple[str, int]:
    """The message of an error in one line, and the exit code."""
    name, text = type(error).__name__, str(error)
    if isinstance(error, ConformodalError):
        return text, BAD_INPUT
    if isinstance(error, OSError):
        file = os.fsdecode(error.filename) + ": " if isinstance(error.filename, (str, bytes, os.PathLike)) else ""
        return f"the system refused: {file}{error.strerror or text or name}", REFUSED
    if isinstance(error, MemoryError) or "not enough memory" in text:  # torch says the latter
        return f"the system refused: there is not enough memory: {text or name}", REFUSED
    return f"{name}: {text} (internal error; {SHOW_ALL}=1 shows all of it)", OWN_FAULT


@contextmanager
def stopping(*, gently: bool = False) -> Iterator[list[int]]:
    """Treat SIGTERM and SIGHUP like Ctrl-C, and collect the numbers of the signals.

    With `gently`, the first signal is only collected, for work that looks at the list; the second one interrupts.
    """
    signals: list[int] = []

    def collect(number: int, _: FrameType | None) -> None:
        signals.append(number)
        if not gently or len(signals) > 1:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield signals
        return
    before = {number: signal.getsignal(number) for number in _STOPPING}
    for number, handler in before.items():
        # nohup has SIGHUP ignored; a script has SIGINT ignored in what it starts with &, and may send it all the same
        if handler is not signal.SIG_IGN or number == signal.SIGINT:
            signal.signal(number, collect)
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def stop_code(signals: list[int]) -> int:
    """Exit code of what a signal has stopped."""
    return 128 + (signals[-1] if signals else signal.SIGINT)
