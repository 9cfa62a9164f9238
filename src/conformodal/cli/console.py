"""What all commands print on the terminal: progress, errors on one line, tables, the folder of the results."""

from __future__ import annotations

import functools
import inspect
import io
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any, ParamSpec

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from conformodal.core.progress import StageProgress

from .failures import OWN_FAULT, explained, show_all, stop_code, stopping
from .options import check_options

P = ParamSpec("P")
_LOG_EVERY_S = 10.0
_LOG_HEADER = b"# progress of conformodal\n"  # a log without it is another program's


def plain(text: str) -> str:
    """Text on one line that a terminal shows as it is: control characters and undecodable bytes with backslashes."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class PlainConsole(Console):
    """Prints text as it is: a name or a message is never read as markup, emoji or a command.

    Where the reader closes the pipe, as ``head`` does, the work goes on and nothing more is printed.
    """

    def render_str(self, text: str, **options: Any) -> Text:
        """See :meth:`rich.console.Console.render_str`; every text that is printed comes by here."""
        return super().render_str(plain(text), **{**options, "markup": False, "emoji": False, "highlight": False})

    def on_broken_pipe(self) -> None:
        """Print no more, and let the work go on."""
        self.quiet = True
        with suppress(OSError, ValueError):  # else the interpreter tries once more when it ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


console = PlainConsole()
errors_console = PlainConsole(stderr=True)


def report_errors(command: Callable[P, None]) -> Callable[P, None]:
    """Check options first, and end what goes wrong with one line on stderr and an exit code, see :mod:`.failures`."""
    defaults = {p.name: p.default for p in inspect.signature(command).parameters.values()}

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> None:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        with stopping() as came:
            try:
                check_options(kwargs, defaults)
                command(*args, **kwargs)
            except (typer.Exit, typer.Abort, typer.BadParameter):
                raise
            except KeyboardInterrupt:
                _report_error("interrupted; the same command goes on from what was kept (features, training state)", "")
                raise typer.Exit(stop_code(came)) from None
            except Exception as exc:
                text, code = explained(exc)
                if code == OWN_FAULT and show_all():
                    raise
                _report_error(text)
                raise typer.Exit(code) from exc

    return wrapped


def report_line(text: str) -> None:
    """One line of the result, however long."""
    console.print(text, soft_wrap=True)


def _report_error(text: str, start: str = "error: ") -> None:
    """One line on stderr."""
    errors_console.print(Text(start, style="bold red") + Text(plain(text)), soft_wrap=True)


def report_strongly(text: str) -> None:
    """A line in bold, for what a user must see."""
    console.print(Text(plain(text), style="bold"), soft_wrap=True)


@contextmanager
def warning_lines(category: type[Warning], report: Callable[[str], None] = report_line) -> Iterator[None]:
    """Report each warning of a category as a line at the end, also where an error follows; others stay warnings."""
    came = list[warnings.WarningMessage]()
    try:
        with warnings.catch_warnings(record=True) as came:
            warnings.simplefilter("always", category)
            yield
    finally:
        for its in came:
            if issubclass(its.category, category):
                report(str(its.message))
            else:
                warnings.showwarning(its.message, its.category, its.filename, its.lineno)


@contextmanager
def progress_bars(out: Path | None = None) -> Iterator[StageProgress]:
    """Bars for stages: call the yielded function with stage, steps done and steps in all.

    Every ten seconds, a line with the stages under way is written into the file ``OUT.log`` beside the folder of the
    results, if there is one. Another program's file of that name, or that of a pipe into it, stays as it is.
    """
    columns = (TextColumn("{task.description:>12}", markup=False), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=errors_console) as progress:
        tasks: dict[str, int] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)  # type: ignore[arg-type]

        ended = Event()
        if out is not None:
            Thread(target=_log_progress, args=(out, progress, ended), daemon=True).start()
        try:
            yield report
        finally:
            ended.set()


def _log_progress(out: Path, progress: Progress, ended: Event) -> None:
    log, mode = out.resolve(), "wb"
    log = log.with_name(f"{log.name}.log")
    while not ended.wait(_LOG_EVERY_S):
        tasks = [task for task in progress.tasks if not task.finished] or progress.tasks[-1:]
        stages = ", ".join(f"{task.description} {task.completed:g}/{task.total:g}" for task in tasks)
        line = f"{time.strftime('%Y-%m-%d %H:%M:%S')} {stages}\n".encode()
        with suppress(OSError):  # what cannot be written stops no work
            if log.exists():
                with log.open("rb") as file:
                    if file.read(len(_LOG_HEADER)) != _LOG_HEADER:
                        return
            with log.open(mode) as file:
                file.write(line if mode == "ab" else _LOG_HEADER + line)
            mode = "ab"


_NAMES = {
    "online": "online, as a robot gets it",
    "smoothed": "smoothed, with hindsight",
    "hindsight": "hindsight, not smoothed",
}


def print_errors(errors: dict[str, dict[str, float]], note: str) -> None:
    """The error table on the terminal."""
    table = Table(title=f"errors, {note}", title_justify="left")
    for column in ("method", "rmse_m", "rmse_deg", "median_m", "median_deg"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for name, row in errors.items():
        table.add_row(
            _NAMES.get(name, name), *(f"{row[key]:.4f}" for key in ("rmse_m", "rmse_deg", "median_m", "median_deg"))
        )
    console.print(table)


def print_where(folder: Path) -> None:
    """The last line: where the results are."""
    report_line(f"results: {folder.resolve()}")
