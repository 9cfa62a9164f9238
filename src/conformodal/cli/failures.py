"""Errors that end a command: one line on stderr, and an exit code for each kind of error."""

from __future__ import annotations

import os
import signal
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from conformodal.core.errors import ConformodalError

# 0 all went well; 1 `data check` found something; 128 + n stopped by signal n, as shells say it
BAD_INPUT, BROKE_OFF, REFUSED, OWN_FAULT = 2, 3, 4, 70
SHOW_ALL = "CONFORMODAL_DEBUG"
_STOPPING = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory", "insufficient memory")


@contextmanager
def stopping(*, gently: bool = False) -> Iterator[list[int]]:
    """Treat SIGTERM and SIGHUP like Ctrl-C, and collect the numbers of the signals that come.

    With `gently`, the first signal is only collected, for work that looks at the list; the second one interrupts.
    """
    came: list[int] = []

    def take(number: int, _: FrameType | None) -> None:
        came.append(number)
        if not gently or len(came) > 1:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = {number: signal.getsignal(number) for number in _STOPPING}
    for number, handler in before.items():
        # nohup has SIGHUP ignored; a script has SIGINT ignored in what it starts with &, and may send it all the same
        if handler is not signal.SIG_IGN or number == signal.SIGINT:
            signal.signal(number, take)
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def stop_code(came: list[int]) -> int:
    """Exit code of what a signal has stopped."""
    return 128 + (came[-1] if came else signal.SIGINT)


def explained(error: Exception) -> tuple[str, int]:
    """The message of an error in one line, and the exit code."""
    name, text = type(error).__name__, str(error)
    if isinstance(error, ConformodalError):
        return f"{name}: {text}", BAD_INPUT
    if isinstance(error, OSError):
        where = f"{_path(error)}: " if error.filename is not None else ""
        return f"the system refused: {where}{error.strerror or text or name}", REFUSED
    if isinstance(error, MemoryError) or any(words in text.lower() for words in _NO_MEMORY):
        return f"the system refused: there is not enough memory: {text or name}", REFUSED
    return f"{name}: {text} (a fault of this program, {_place(error)}; {SHOW_ALL}=1 shows all of it)", OWN_FAULT


def show_all() -> bool:
    """Whether the environment asks for the traceback of an error."""
    return bool(os.environ.get(SHOW_ALL))


def _path(error: OSError) -> str:
    return os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else str(error.filename)


def _place(error: Exception) -> str:
    """The last place of this package that an error went through."""
    root = Path(__file__).resolve().parents[1]
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).is_relative_to(root)]
    return f"{Path(frames[-1].filename).relative_to(root)}:{frames[-1].lineno}" if frames else "outside of it"
