"""What all commands print on the terminal: lines, progress, and the folder of the results."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from conformodal.core.progress import StageProgress

LOG = "progress.log"
_LOG_EVERY_S = 10.0


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


def report_line(text: str) -> None:
    """One line of the result, however long."""
    console.print(text, soft_wrap=True)


def report_strongly(text: str) -> None:
    """A line in bold, for what a user must see."""
    console.print(Text(plain(text), style="bold"), soft_wrap=True)


def report_error(text: str) -> None:
    """One line on stderr."""
    errors_console.print(Text("error: ", style="bold red") + Text(plain(text)), soft_wrap=True)


def print_where(folder: Path) -> None:
    """The last line: where the results are."""
    report_line(f"results: {folder.resolve()}")


@contextmanager
def warning_lines(category: type[Warning], report: Callable[[str], None] = report_line) -> Iterator[None]:
    """Report each warning of a category as a line at the end, also where an error follows; others stay warnings."""
    caught = list[warnings.WarningMessage]()
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", category)
            yield
    finally:
        for warning in caught:
            if issubclass(warning.category, category):
                report(str(warning.message))
            else:
                warnings.showwarning(warning.message, warning.category, warning.filename, warning.lineno)


@contextmanager
def progress_bars(folder: Path | None = None) -> Iterator[StageProgress]:
    """One bar per stage; every ten seconds, a line with the stages under way in ``progress.log`` of the folder."""
    columns = (TextColumn("{task.description:>12}", markup=False), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=errors_console) as progress:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage)
            progress.update(tasks[stage], completed=done, total=total or None)

        ended = Event()
        if folder is not None:
            Thread(target=_log_progress, args=(folder / LOG, progress, ended), daemon=True).start()
        try:
            yield report
        finally:
            ended.set()


def _log_progress(log: Path, progress: Progress, ended: Event) -> None:
    mode = "w"
    while not ended.wait(_LOG_EVERY_S):
        tasks = [task for task in progress.tasks if not task.finished] or progress.tasks[-1:]
        stages = ", ".join(f"{task.description} {task.completed:g}/{task.total or 0:g}" for task in tasks)
        with suppress(OSError), log.open(mode, encoding="utf-8") as file:  # a log that cannot be written stops no work
            file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {stages}\n")
            mode = "a"
