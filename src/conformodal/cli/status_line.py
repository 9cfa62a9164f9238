"""The line that changes while a stream runs."""

from __future__ import annotations

import time
from collections import deque
from typing import Self

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from conformodal.core.words import counted
from conformodal.localizer.region_rules import EvidenceType
from conformodal.pipeline.estimates import Estimate

from .console import errors_console, plain


class StatusLine:
    """One line that changes while a stream runs: frames, frames per second, known place or not, reliable or not."""

    def __init__(self, n_frames: int | None) -> None:
        columns = (
            TextColumn("{task.fields[fps]:5.1f} fps"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}", markup=False),
        )
        self._progress = Progress(*columns, TimeRemainingColumn(), console=errors_console)
        self._task = self._progress.add_task("frames", total=n_frames, fps=0.0, state="")
        self._recent: deque[float] = deque(maxlen=30)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def update(self, done: int, estimate: Estimate) -> None:
        """Show the outcome of the newest frame."""
        self._recent.append(time.perf_counter())
        passed = self._recent[-1] - self._recent[0]
        fps = (len(self._recent) - 1) / passed if passed > 0 else 0.0
        self._progress.update(self._task, completed=done, fps=fps, state=plain(state_of(estimate)))


def state_of(estimate: Estimate) -> str:
    """The outcome of a frame, in a few words."""
    if estimate.region is None:
        return f"no answer: {estimate.problem}"
    if estimate.evidence is EvidenceType.UNKNOWN:
        motion = estimate.relative_motion
        lost = "" if motion is None or motion.reliable else f", {motion.status}"
        return f"unknown place (p = {estimate.known_p:.2g}){lost}"
    region = estimate.path_region or estimate.region
    places = counted(int(region.n_places[0]), "place")
    p = "" if estimate.known_p is None else f", known p {estimate.known_p:.2f}"
    return f"{'reliable' if estimate.reliable else estimate.problem}{p}, {places}"
