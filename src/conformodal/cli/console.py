"""What all verbs share on the terminal: progress, kind errors, the last line."""

from __future__ import annotations

import functools
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ParamSpec, Self

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from conformodal.conformal import ConformodalError
from conformodal.odometry import Estimate, Evidence

P = ParamSpec("P")
Report = Callable[[str, int, int], None]

console = Console(highlight=False)
_errors = Console(stderr=True, highlight=False)

INTERRUPTED = 130
BAD_INPUT = 2


def kind_errors(command: Callable[P, None]) -> Callable[P, None]:
    """Turn this package's errors into one line on stderr and exit code 2, and Ctrl-C into 130."""

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except ConformodalError as exc:
            _errors.print(f"[bold red]error:[/] {type(exc).__name__}: ", end="")
            _errors.print(str(exc), markup=False, soft_wrap=True)
            raise typer.Exit(BAD_INPUT) from exc
        except KeyboardInterrupt:
            _errors.print("interrupted; the same command goes on from what was kept (features, training state)")
            raise typer.Exit(INTERRUPTED) from None

    return wrapped


@contextmanager
def progress_bars() -> Iterator[Report]:
    """Bars for stages: call the yielded function with stage, steps done and steps in all."""
    columns = (TextColumn("{task.description:>12}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=_errors) as progress:
        tasks: dict[str, int] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)  # type: ignore[arg-type]

        yield report


def print_errors(errors: dict[str, dict[str, float]], note: str) -> None:
    """The error table on the terminal."""
    table = Table(title=f"errors, {note}", title_justify="left")
    for column in ("method", "rmse_m", "rmse_deg", "median_m", "median_deg"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for name, row in errors.items():
        table.add_row(name, *(f"{row[key]:.4f}" for key in ("rmse_m", "rmse_deg", "median_m", "median_deg")))
    console.print(table)


def print_where(folder: Path) -> None:
    """The last line: where the results are."""
    sys.stdout.flush()
    console.print(f"results: {folder.resolve()}", soft_wrap=True)


class StatusLine:
    """One line that changes while a stream runs: frames, frames a second, known place or not, reliable or not.

    Parameters
    ----------
    n_frames
        To come, if known.
    """

    def __init__(self, n_frames: int | None) -> None:
        columns = (
            TextColumn("{task.fields[fps]:5.1f} fps"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}"),
        )
        self._progress = Progress(*columns, TimeRemainingColumn(), console=_errors)
        self._task = self._progress.add_task("frames", total=n_frames, fps=0.0, state="")
        self._recent: deque[float] = deque(maxlen=30)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(self, done: int, estimate: Estimate) -> None:
        """Say what became of the newest frame."""
        self._recent.append(time.perf_counter())
        passed = self._recent[-1] - self._recent[0]
        fps = (len(self._recent) - 1) / passed if passed > 0 else 0.0
        self._progress.update(self._task, completed=done, fps=fps, state=state_of(estimate))


def state_of(estimate: Estimate) -> str:
    """What became of a frame, in a few words."""
    if estimate.region is None:
        return f"no answer: {estimate.problem}"
    if estimate.evidence is Evidence.UNKNOWN:
        motion = estimate.relative_motion
        lost = "" if motion is None or motion.reliable else f", {motion.status}"
        return f"unknown place (p = {estimate.known_p:.2g}){lost}"
    counts = " ".join(f"{name}:{k}" for name, k in zip("xyz", estimate.region.n_intervals[0], strict=False))
    p = "" if estimate.known_p is None else f", known p {estimate.known_p:.2f}"
    return f"{'reliable' if estimate.reliable else estimate.problem}{p}, intervals {counts}"
