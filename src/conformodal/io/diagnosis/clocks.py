"""Doubts about clocks: times in another unit than seconds, clocks that do not meet, and one that is ahead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory

_SINCE_1970_S = 1e8
_UNITS = {"nanoseconds": 1e9, "microseconds": 1e6, "milliseconds": 1e3}
_NO_SECONDS = 1e11  # the year five thousand
_USUAL_STEP_S = (5e-4, 5.0)  # from frame to frame
_MUCH_LONGER = 300.0  # times as long a step is in another unit than seconds
_MAX_SHIFT_S, _COARSE_S, _MIN_STEPS, _MIN_OVERLAP = 60.0, 0.1, 20, 0.5
_CLEAR, _BETTER = 0.6, 0.2  # rank correlation of speeds at the right shift, and above that as given


def in_seconds(times: FloatArray) -> tuple[FloatArray, str]:
    """Times in seconds; and their unit, if they are too large for seconds, else nothing.

    Those since 1970 show it by their size, those of another clock by their steps, of 0.1 to 1000 per second.
    """
    finite = np.unique(times[np.isfinite(times)])
    size = float(np.median(np.abs(finite))) if finite.size else 0.0
    if size < _NO_SECONDS:
        return times, ""
    step = float(np.median(np.diff(finite))) if finite.size > 1 else 0.0
    for unit, per_second in _UNITS.items():
        if 0.5 < size / (1e9 * per_second) < 5 and step < 10 * per_second:  # 1985 to 2128
            return times / per_second, unit
    unit = next((unit for unit, per_second in _UNITS.items() if step >= per_second / 1000), "milliseconds")
    return times / _UNITS[unit], unit


def clock_hint(times_s: FloatArray, others_s: FloatArray) -> str:
    """Why two sets of times do not meet, where their size shows it; else nothing."""
    sizes = [float(np.median(t)) for t in (times_s, others_s)]
    spans = sorted((float(np.ptp(times_s)), float(np.ptp(others_s))))
    for unit, per_second in _UNITS.items():
        if 0 < spans[0] * per_second / 3 < spans[1] < 3 * spans[0] * per_second:
            return f"; one covers {spans[1]:.4g}, the other {spans[0]:.4g}: looks like {unit}, expected seconds"
    if times_s.max() < others_s.min() or others_s.max() < times_s.min():
        counts = "; one counts from 1970" if max(sizes) > _SINCE_1970_S > min(sizes) else ""
        return f"; the clocks are {abs(sizes[0] - sizes[1]):.6g} s apart{counts}: shift the poses by --time-offset"
    return ""


def doubt_rate(step_s: float) -> str:
    """Whether frames so far apart have times in another unit than seconds; nothing where they may be seconds."""
    if _USUAL_STEP_S[0] <= step_s <= _USUAL_STEP_S[1]:
        return ""
    return f"frames are {step_s:.3g} s apart; are their times in another unit than seconds?"


def doubt_steps(steps_s: Sequence[float], expected_s: float) -> str:
    """Whether the first steps of a stream are in another unit than those of the training data; else nothing."""
    usual = float(np.median(steps_s))
    if usual <= _MUCH_LONGER * expected_s:
        return ""
    return (
        f"timestamps must be in seconds: the first {len(steps_s)} steps are usually {usual:.3g} long, those of the "
        f"training data {expected_s:.3g} s; are they in milliseconds or nanoseconds?"
    )


def describe_time_offset(estimate: Trajectory, truth: Trajectory) -> str:
    """The shift in time under which two paths move alike, if as given they do not; else nothing.

    Compares the ranks of the speeds from pose to pose of the estimate, so neither world nor scale must be the same.
    """
    from scipy.stats import spearmanr  # noqa: PLC0415 - it takes time to import, and no reader needs it

    times = estimate.timestamps_s
    if len(times) <= _MIN_STEPS or len(truth) <= _MIN_STEPS:
        return ""
    steps = np.diff(times)
    speeds = np.linalg.norm(np.diff(estimate.positions_xyz, axis=0), axis=1) / steps
    order = np.argsort(truth.timestamps_s, kind="stable")
    true_times, true_positions = truth.timestamps_s[order], truth.positions_xyz[order]
    max_gap_s = 3 * max(float(np.median(steps)), float(np.median(np.diff(true_times))))

    def correlation(shift_s: float) -> float:
        at = times + shift_s
        positions = np.column_stack([np.interp(at, true_times, column) for column in true_positions.T])
        after = np.clip(np.searchsorted(true_times, at), 1, len(true_times) - 1)
        inside = (at >= true_times[0]) & (at <= true_times[-1])
        inside &= true_times[after] - true_times[after - 1] <= max_gap_s
        true_speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / steps
        both = inside[1:] & inside[:-1]
        if both.mean() < _MIN_OVERLAP or not np.ptp(true_speeds[both]):
            return -1.0
        return float(spearmanr(speeds[both], true_speeds[both]).statistic)

    given = correlation(0.0)
    if given > 1 - _BETTER:
        return ""
    shifts = np.arange(-_MAX_SHIFT_S, _MAX_SHIFT_S, _COARSE_S)
    nearest = float(shifts[np.argmax([correlation(shift) for shift in shifts])])
    closer = nearest + np.linspace(-_COARSE_S, _COARSE_S, 21)
    alike = [correlation(shift) for shift in closer]
    best, most = float(closer[np.argmax(alike)]), max(alike)
    if most < max(_CLEAR, given + _BETTER):
        return ""
    return (
        f"its clock seems to be {abs(best):.3g} s {'ahead' if best > 0 else 'behind'}: the speeds of the two paths "
        f"agree then (rank correlation {most:.2f}, as given {max(given, 0):.2f}); try --time-offset {-best:.3g}"
    )
