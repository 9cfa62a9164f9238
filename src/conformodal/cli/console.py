"""What all commands share on the terminal: lines, progress, and how errors and signals end a command."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, cast

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TimeElapsedColumn, TimeRemainingColumn

from conformodal.core.errors import ConformodalError
from conformodal.core.progress import StageProgress

# 0 all went well; 1 `data check` found something; 128 + n stopped by signal n, as shells say it
BAD_INPUT, BROKE_OFF, REFUSED, OWN_FAULT = 2, 3, 4, 70
SHOW_ALL = "CONFORMODAL_DEBUG"  # set in the environment, it shows the traceback of an error of this program
# click's ClickException, of which newer versions of Typer have a copy
_USAGE_ERROR = cast("type[Exception]", typer.BadParameter.__mro__[2])
_LOG, _LOG_EVERY_S = "progress.log", 10.0
_STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


class OptionError(ConformodalError):
    """An option that cannot be used, or contradicts another."""


def plain(text: str) -> str:
    """Text on one line that a terminal shows as it is: control characters and undecodable bytes with backslashes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def report_line(text: str, *, bold: bool = False) -> None:
    """One line of the result, however long; in bold, what a user must see.

    Where the reader closes the pipe, as ``head`` does, the work goes on and nothing more is printed.
    """
    line = plain(text)
    try:
        typer.echo(typer.style(line, bold=True) if bold else line)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def report_error(text: str) -> None:
    """One line on stderr."""
    typer.echo(typer.style("error: ", fg="red", bold=True) + plain(text), err=True)


def print_where(folder: Path) -> None:
    """The last line: where the results are."""
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
    """One bar per stage; in a folder, ``progress.log`` gets a line with the stage under way every ten seconds."""
    columns = ("{task.description:>12}", BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    logged_at, mode = time.monotonic(), "w"
    with Progress(*columns, console=Console(stderr=True)) as progress:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            nonlocal logged_at, mode
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage)
            progress.update(tasks[stage], completed=done, total=total or None)
            if folder is not None and time.monotonic() > logged_at + _LOG_EVERY_S:
                logged_at = time.monotonic()
                # a log that cannot be written stops no work
                with suppress(OSError), (folder / _LOG).open(mode, encoding="utf-8") as file:
                    file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {stage} {done}/{total}\n")
                    mode = "a"

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
        except (typer.Exit, typer.Abort, _USAGE_ERROR):
            raise
        except KeyboardInterrupt:
            report_error("interrupted; what was computed until now is kept")
            raise typer.Exit(stop_code(signals)) from None
        except Exception as exc:
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
    return f"{name}: {text} (a fault of this program; {SHOW_ALL}=1 shows all of it)", OWN_FAULT


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
