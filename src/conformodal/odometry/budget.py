"""A time that the answer to a frame may take, and whether there is time left to match local features."""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from .errors import BudgetWarning, OdometryError

WINDOW, ALLOWED = 200, 2  # frames, and how many of them may take longer: so that the 99th percentile does not
_COLD = 3  # the first frames of a process fill caches and are not counted
_KNOWN_AFTER = 20  # frames without matching, before they say that the budget cannot be kept
_TIMES_KEPT = 10_000


@dataclass(frozen=True)
class BudgetRecord:
    """How a budget was kept.

    Attributes
    ----------
    budget_ms
        What was asked for.
    n_frames, n_over
        Frames that were counted (not the first three), and those of them that took longer.
    median_ms, p99_ms
        Of the last 10,000 frames; NaN of none.
    unmatched_ms
        Median of those without matching, which is the least that a frame takes; NaN of none.
    """

    budget_ms: float
    n_frames: int
    n_over: int
    median_ms: float
    p99_ms: float
    unmatched_ms: float

    @property
    def out_of_reach(self) -> bool:
        """Whether frames take longer than the budget even without matching."""
        return self.unmatched_ms > self.budget_ms

    def table(self) -> dict[str, float | int | bool | None]:
        """For ``metrics.json``."""
        found = {k: None if math.isnan(v) else round(v, 3) for k, v in asdict(self).items()}
        return {**found, "out_of_reach": self.out_of_reach}


class FrameBudget:
    """Decides before a frame is looked at whether its local features are matched, by what frames before it took.

    Matching is the part of the work that can be left out: a region without it is wider and calibrated as well. It is
    left out where two of the last two hundred frames took longer than the budget, and tried again when they no longer
    are among these. So at most one frame in a hundred exceeds the budget because of matching, and the 99th percentile
    is kept if frames without matching keep it.

    Regions stay valid if the decision says nothing about the image. It never looks at the image. Frames that are drawn
    independently of each other have nothing to do with what others took, so there the promise is exact. In a video it
    rests on an assumption: how long the last two hundred frames took may depend a little on what they show (their
    corners, the places that they resemble), and the next frame shows much the same. The promise is kept as far as this
    does not tell how hard the next image is.

    Parameters
    ----------
    budget_ms
        Milliseconds that a frame may take.
    clock
        Seconds, never going back.

    Raises
    ------
    OdometryError
        If the budget is no positive finite number.
    """

    def __init__(self, budget_ms: float, clock: Callable[[], float] = time.perf_counter) -> None:
        if not (math.isfinite(budget_ms) and budget_ms > 0):
            raise OdometryError(f"budget_ms must be a positive number of milliseconds, got {budget_ms}")
        self.budget_ms = float(budget_ms)
        self._clock = clock
        self._over: deque[bool] = deque(maxlen=WINDOW)
        self._times: deque[tuple[float, bool]] = deque(maxlen=_TIMES_KEPT)
        self._n_seen = self._n_over = 0
        self._started_s = 0.0
        self._warned = False

    @property
    def has_room(self) -> bool:
        """Whether the next frame's local features may be matched."""
        return sum(self._over) < ALLOWED

    def start(self) -> None:
        """The work on a frame begins."""
        self._started_s = self._clock()

    def stop(self, *, matched: bool) -> None:
        """The work on a frame is done; `matched` says whether its local features were matched.

        Warns once if frames without matching exceed the budget.
        """
        took_ms = 1e3 * (self._clock() - self._started_s)
        self._n_seen += 1
        if self._n_seen <= _COLD:
            return
        over = took_ms > self.budget_ms
        self._over.append(over)
        self._times.append((took_ms, matched))
        self._n_over += over
        if over and not matched and not self._warned:
            self._warn_if_out_of_reach()

    def _warn_if_out_of_reach(self) -> None:
        last = [took for took, matched in list(self._times)[-WINDOW:] if not matched]
        if len(last) >= _KNOWN_AFTER and (least := float(np.median(last))) > self.budget_ms:
            self._warned = True
            warnings.warn(
                f"a frame takes {least:.1f} ms (median) even if local features are not matched: the budget of "
                f"{self.budget_ms:g} ms cannot be kept",
                BudgetWarning,
                stacklevel=4,
            )

    @property
    def record(self) -> BudgetRecord:
        """How it was kept so far."""
        times = np.array([took for took, _ in self._times])
        least = [took for took, matched in self._times if not matched]
        return BudgetRecord(
            self.budget_ms,
            max(self._n_seen - _COLD, 0),
            self._n_over,
            float(np.median(times)) if times.size else math.nan,
            float(np.percentile(times, 99)) if times.size else math.nan,
            float(np.median(least)) if least else math.nan,
        )


def as_budget(budget: float | FrameBudget) -> FrameBudget:
    """A budget, of milliseconds or as it is.

    Raises
    ------
    OdometryError
        If the milliseconds are not positive.
    """
    return budget if isinstance(budget, FrameBudget) else FrameBudget(budget)
