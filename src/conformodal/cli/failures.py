"""Errors and signals that end a command: one line on stderr, and an exit code for each kind."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import typer

from conformodal.core.errors import ConformodalError

from .console import report_error


class OptionError(ConformodalError):
    """An option that cannot be used, or contradicts another."""


# 0 all went well; 1 `data check` found something; 128 + n stopped by signal n, as shells say it
BAD_INPUT, BROKE_OFF, REFUSED, OWN_FAULT = 2, 3, 4, 70
SHOW_ALL = "CONFORMODAL_DEBUG"  # set in the environment, it shows the traceback of an error of this program
_STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "insufficient memory")


@contextmanager
def report_errors() -> Iterator[None]:
    """End what goes wrong in a command, which this decorates, with one line on stderr and an exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    with stopping() as signals:
        try:
            yield
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except KeyboardInterrupt:
            report_error("interrupted; what was computed until now is kept")
            raise typer.Exit(stop_code(signals)) from None
        except Exception as exc:
            text, code = explained(exc)
            if code == OWN_FAULT and os.environ.get(SHOW_ALL):
                raise
            report_error(text)
            raise typer.Exit(code) from exc


def explained(error: Exception) -> tuple[str, int]:
    """The message of an error in one line, and the exit code."""
    name, text = type(error).__name__, str(error)
    if isinstance(error, ConformodalError):
        return text, BAD_INPUT
    if isinstance(error, OSError):
        file = os.fsdecode(error.filename) + ": " if isinstance(error.filename, (str, bytes, os.PathLike)) else ""
        return f"the system refused: {file}{error.strerror or text or name}", REFUSED
    if isinstance(error, MemoryError) or any(words in text.lower() for words in _NO_MEMORY):
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
