"""Why a given truth may not be what it seems, told from an estimate of the same path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from conformodal.core.arrays import FloatArray
from conformodal.geometry import Trajectory

from .axes import describe_axes, signed_permutations
from .stale import describe_stretches, stale_truth

_SAME_DEG, _TURNS_DEG = 0.01, 5.0  # orientations that never change, while the camera turns
_WRONG_DEG, _MENDED = 10.0, 1 / 3  # a median error that asks for a cause, and what is left of it with the right one
_AXES_DEG = 5.0  # from a rotation to one of axes onto axes
_UNITS = {"centimetres": 100.0, "millimetres": 1000.0}


@dataclass(frozen=True)
class TruthDoubts:
    """What is doubtful about a truth."""

    positions_only: bool  # whether its orientations are none: only positions can be compared
    reasons: tuple[str, ...]  # one sentence each; empty where nothing is doubtful


def doubt_truth(estimate: Trajectory, truth: Trajectory, unit: str = "m") -> TruthDoubts:
    """Doubts about the orientations of a truth, and about the body that it is of, of poses (n,) of the same frames.

    `unit` is that of lengths.
    """
    if len(truth) < 2:
        return TruthDoubts(False, ())
    far, true_far = (float(np.linalg.norm(np.ptp(path.positions_xyz, axis=0))) for path in (estimate, truth))
    for other, factor in _UNITS.items():
        if 0.7 * factor * far < true_far < 1.4 * factor * far:
            times = f"it reaches {true_far:.3g} where the estimate reaches {far:.3g}"
            return TruthDoubts(False, (f"{times}: its positions seem to be in {other}, expected metres",))
    rotations = [Rotation.from_quat(path.orientations_quat_wxyz, scalar_first=True) for path in (estimate, truth)]
    turns_deg = [np.degrees((r[0].inv() * r).magnitude()) for r in rotations]
    if turns_deg[1].max() < _SAME_DEG and np.median(turns_deg[0]) > _TURNS_DEG:
        reason = f"its orientations are all the same, and the camera turns by {turns_deg[0].max():.0f} degrees"
        return TruthDoubts(True, (f"{reason}: it has none, and only positions are compared",))
    doubts = (
        _doubt_repeats(estimate, truth),
        _doubt_orientations(*rotations),
        _doubt_body(rotations[0], estimate, truth, unit),
    )
    return TruthDoubts(False, tuple(filter(None, doubts)))


def _doubt_repeats(estimate: Trajectory, truth: Trajectory) -> str:
    """Whether poses of the truth repeat while the estimate moves."""
    rows = [np.column_stack((path.positions_xyz, path.orientations_quat_wxyz)) for path in (estimate, truth)]
    stretches = stale_truth(truth.timestamps_s, rows[1], rows[0])
    if not stretches:
        return ""
    told = describe_stretches("it", "pose", stretches, truth.timestamps_s, len(truth))
    return f"{told}, while the estimate moves; leave these out"


def _axes_like(turns: Rotation) -> str:
    """The axes that a constant rotation (from the camera's frame to the body's) leads to, if it is one of axes."""
    columns = turns.mean().inv().as_matrix()
    nearest = min(signed_permutations(proper=True), key=lambda axes: float(np.abs(axes - columns).max()))
    apart_deg = np.degrees((Rotation.from_matrix(nearest) * turns.mean()).magnitude())
    return f", as of {describe_axes(nearest)}" if apart_deg < _AXES_DEG else ""


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
        f"the frame of the {where}{_axes_like(turns) if where == 'camera' else ''}, {left[where]:.2g} degrees are left "
        f"(median): {what}"
    )


def _doubt_body(turns: Rotation, estimate: Trajectory, truth: Trajectory, unit: str) -> str:
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
    frame = f"in the frame of the {where} ({left[where]:.1g} {unit} are left, median)"
    return f"it lies a constant {offset_m:.2g} {unit} from the estimate, {frame}: it {cause}"
