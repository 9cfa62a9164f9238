"""Why a given truth may not be what it seems, told from an estimate of the same path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory

_SAME_DEG, _TURNS_DEG = 0.01, 5.0  # orientations that never change, while the camera turns
_WRONG_DEG, _MENDED = 10.0, 1 / 3  # a median error that asks for a cause, and what is left of it with the right one
_UNITS = {"centimetres": 100.0, "millimetres": 1000.0}
_MOST_SHIFT_S, _COARSE_S, _LEAST_STEPS, _LEAST_OVERLAP = 60.0, 0.1, 20, 0.5
_CLEAR, _BETTER = 0.6, 0.2  # rank correlation of speeds at the right shift, and above that as given


@dataclass(frozen=True)
class TruthDoubts:
    """What is doubtful about a truth."""

    positions_only: bool  # whether its orientations are none: only positions can be compared
    reasons: tuple[str, ...]  # one sentence each; empty where nothing is doubtful


def doubt_truth(estimate: Trajectory, truth: Trajectory) -> TruthDoubts:
    """Doubts about the orientations of a truth, and about the body that it is of, of poses (n,) of the same frames."""
    if len(truth) < 2:
        return TruthDoubts(False, ())
    far, true_far = (float(np.linalg.norm(np.ptp(path.positions_xyz, axis=0))) for path in (estimate, truth))
    for unit, factor in _UNITS.items():
        if 0.7 * factor * far < true_far < 1.4 * factor * far:
            times = f"it reaches {true_far:.3g} where the estimate reaches {far:.3g}"
            return TruthDoubts(False, (f"{times}: its positions seem to be in {unit}, expected metres",))
    rotations = [Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True) for path in (estimate, truth)]
    turns_deg = [np.degrees((r[0].inv() * r).magnitude()) for r in rotations]
    if turns_deg[1].max() < _SAME_DEG and np.median(turns_deg[0]) > _TURNS_DEG:
        reason = f"its orientations are all the same, and the camera turns by {turns_deg[0].max():.0f} degrees"
        return TruthDoubts(True, (f"{reason}: it has none, and only positions are compared",))
    reasons = (_doubt_orientations(*rotations), _doubt_body(rotations[0], estimate, truth))
    return TruthDoubts(False, tuple(filter(None, reasons)))


def _doubt_orientations(estimate: Rotation, truth: Rotation) -> str:
    """The cause of orientations that are far from the estimate's, if one explains most of the difference."""

    def median_deg(turns: Rotation) -> float:
        return float(np.median(np.degrees(turns.magnitude())))

    given = median_deg(truth.inv() * estimate)
    if given < _WRONG_DEG:
        return ""
    quats = truth.as_quat(scalar_first=True)
    first, last = (Rotation.from_quat(np.roll(quats, by, axis=1), scalar_first=True) for by in (-1, 1))
    for seeming, rotations, mend in (
        ("its quaternions seem to be in the order w x y z", first, "reorder them"),
        ("its quaternions seem to be in the order x y z w", last, "reorder them"),
        ("its poses seem to be world-to-camera", truth.inv(), "invert them"),
    ):
        mended = median_deg(rotations.inv() * estimate)
        if mended < _MENDED * given:
            return f"{seeming}: {mended:.2g} degrees from the estimate then (median), {given:.3g} as read; {mend}"
    causes = {
        "camera": (truth.inv() * estimate, "it is of another body of the rig, or of other axes; give the camera's"),
        "world": (estimate * truth.inv(), "it is of another world; align it (--align se3)"),
    }
    left = {where: median_deg(turns.mean().inv() * turns) for where, (turns, _) in causes.items()}
    where = min(left, key=lambda frame: left[frame])
    if left[where] >= min(_MENDED * given, _WRONG_DEG):
        return ""
    turns, what = causes[where]
    return (
        f"its orientations differ by a constant rotation of {np.degrees(turns.mean().magnitude()):.0f} degrees in "
        f"the frame of the {where}, {left[where]:.2g} degrees are left (median): {what}"
    )


def _doubt_body(turns: Rotation, estimate: Trajectory, truth: Trajectory) -> str:
    """Whether the truth lies at a constant place beside the estimate, in the frame of the camera or of the world."""
    apart = truth.positions_xyz - estimate.positions_xyz

    def spread_m(offsets: FloatArray) -> float:
        return float(np.median(np.linalg.norm(offsets - np.median(offsets, axis=0), axis=1)))

    given_m = float(np.median(np.linalg.norm(apart, axis=1)))
    in_camera = turns.inv().apply(apart)
    left = {"camera": spread_m(in_camera), "world": spread_m(apart)}
    where = min(left, key=lambda frame: left[frame])
    offset_m = float(np.linalg.norm(np.median(in_camera if where == "camera" else apart, axis=0)))
    if left[where] > _MENDED * min(given_m, offset_m, max(left.values())):
        return ""
    cause = "is of another body of the rig; give the camera's poses"
    if where == "world":
        cause = "is of another world; align it (--align se3)"
    return (
        f"it lies a constant {offset_m:.2g} m from the estimate, in the frame of the {where} ({left[where]:.1g} m are "
        f"left, median): it {cause}"
    )


def doubt_clock(estimate: Trajectory, truth: Trajectory) -> str:
    """The shift in time under which two paths move alike, if as given they do not; else nothing.

    Compares the ranks of the speeds from pose to pose of the estimate, so neither world nor scale must be the same.
    """
    times = estimate.timestamps_s
    if len(times) <= _LEAST_STEPS or len(truth) <= _LEAST_STEPS:
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
        if both.mean() < _LEAST_OVERLAP or not np.ptp(true_speeds[both]):
            return -1.0
        return float(spearmanr(speeds[both], true_speeds[both]).statistic)

    given = correlation(0.0)
    if given > 1 - _BETTER:
        return ""
    shifts = np.arange(-_MOST_SHIFT_S, _MOST_SHIFT_S, _COARSE_S)
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
