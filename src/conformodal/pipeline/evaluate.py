"""Evaluation of a run: errors of every method, and coverage of the regions with its exact band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from conformodal.conformal import grouped_coverage_band
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, Rows
from conformodal.core.words import finite_or_none
from conformodal.geometry import TARGET_NAMES, Trajectory, pose_targets, trajectory_errors
from conformodal.localizer.observations import same_place
from conformodal.localizer.regions import EvidenceType, PoseRegions
from conformodal.localizer.rooms import weighs_enough

from .guarantee import describe_guarantee
from .model import ONLINE, PoseModel

_AT_RANDOM = "These frames were drawn at random together with those that calibrate"
_ONE_LAW = f"{_AT_RANDOM}: the covered count of each evidence type follows a Beta-binomial law."
_LAW_PER_TARGET = (
    f"{_AT_RANDOM}: for each evidence type the covered count of a target follows a Beta-binomial law. "
    "For the whole pose there is no exact law."
)
_MIXED = (
    f"{_AT_RANDOM}, but some images are disturbed as no training image is; copies disturbed at random calibrate their "
    "regions, so there is no exact band."
)
_SMALL_ROOMS = (
    f"{_AT_RANDOM}, but some rooms have too few calibration frames for thresholds of their own, so there is no exact "
    "band."
)
_OBSERVED = "Coverage here is an observation."
_BROKEN = (
    "These are not the frames, or not all of them, that were held out at random together with the calibration frames: "
    "coverage here is an observation, and no guarantee applies."
)
_PATHS_OF_UNITS = (
    "Regions from posteriors are calibrated on held-out stretches (or recordings), each run as a stream by sources "
    "that had not seen it. The guarantee is about a random frame of a new stretch that is run so; it is approximate, "
    "as the motion prior knows the held-out poses."
)
_PATHS_OF_FRAMES = (
    "Regions from posteriors are calibrated on the stream of the frames that were held out at random. The guarantee is "
    "about a stream of as many other frames drawn so, such as the test part, and approximate: posteriors of a stream "
    "with more frames a second, such as a video, are sharper, and nothing is guaranteed for it."
)


@dataclass(frozen=True, eq=False)
class RegionStatistics(Rows):
    """Statistics of the regions of n frames, target by target, (n, 7) each."""

    inside: BoolArray  # whether the set holds the truth
    length: FloatArray  # of the set, in the target's unit; infinite for the whole line
    n_intervals: IntArray  # that the set falls into
    unbounded: BoolArray  # whether it is the whole line
    kinds: IntArray  # (n,) what each region rests on, see :class:`~conformodal.localizer.regions.EvidenceType`
    held: BoolArray  # (n,) whether the region holds the whole pose
    n_places: IntArray  # (n,) cuboids that it consists of
    rooms: IntArray  # (n,) room of each frame by its belief, see :class:`~conformodal.localizer.rooms.Rooms`

    @property
    def bounded(self) -> BoolArray:
        """(n,) whether the set of every target is bounded."""
        return np.asarray(~self.unbounded.any(axis=1))

    def __len__(self) -> int:
        return len(self.inside)

    @classmethod
    def of(
        cls,
        regions: PoseRegions,
        truth: Trajectory,
        sign_reference: FloatArray,
        kinds: IntArray | None = None,
        rooms: IntArray | None = None,
    ) -> RegionStatistics:
        """Statistics of the regions of frames whose poses are known; `kinds` says what each rests on."""
        kinds = np.full(len(regions), EvidenceType.GLOBAL, dtype=np.int64) if kinds is None else kinds
        rooms = np.zeros(len(regions), dtype=np.int64) if rooms is None else rooms
        targets = pose_targets(truth, sign_reference)
        inside, held = regions.contains(targets), regions.contains(targets, joint=True)
        sizes = regions.length, regions.n_intervals, regions.unbounded
        return cls(inside, *sizes, kinds, held, regions.n_places, rooms)


def error_table(trajectories: dict[str, Trajectory], truth: Trajectory) -> dict[str, dict[str, float]]:
    """``rmse_m``, ``rmse_deg`` and medians of every trajectory, by its name: first of the one that a robot gets."""
    ordered = sorted(trajectories, key=lambda name: name != ONLINE)
    return {name: trajectory_errors(trajectories[name], truth) for name in ordered}


def coverage_table(statistics: RegionStatistics, model: PoseModel, *, exchangeable: bool) -> dict[str, Any]:
    """Coverage and size of the regions of the frames that were answered.

    `exchangeable` are frames with the calibration frames, as the test part of an ``interleaved`` split.
    """
    held, finite, rules, calibration = statistics.held, statistics.bounded, model.rules, model.calibration
    # weakly recognised places: the guarantee of others holds, as their thresholds are no smaller
    kinds = np.where(statistics.kinds == EvidenceType.WEAK, EvidenceType.LANDMARKS, statistics.kinds)
    chosen = {kind: kinds == kind for kind in (*rules.by_type, EvidenceType.UNKNOWN)}
    shown = {kind: chosen[kind] for kind in rules.by_type}
    if (weak := statistics.kinds == EvidenceType.WEAK).any():
        shown[EvidenceType.WEAK] = weak
    groups = [
        (rules.in_room(kind, room), int((chosen[kind] & (statistics.rooms == room)).sum()))
        for kind in rules.by_type
        for room in np.unique(statistics.rooms[chosen[kind]]).tolist()
    ]
    met = [(rule.n_units, n) for rule, n in groups]
    met.append((0, int(chosen[EvidenceType.UNKNOWN].sum())))  # always covered
    # small rooms have thresholds that are not of their own frames alone
    own = rules.rooms is None or all(weighs_enough(rule) for rule, _ in groups)
    by_frame, whole = rules.overall.units_ is None, calibration.joint == "max"
    # those that left the range of qualities by chance are not exchangeable with disturbed ones
    alike = not (statistics.kinds == EvidenceType.DISTURBED).any()
    one_law = exchangeable and by_frame and alike and own
    if exchangeable and by_frame:
        reach = (_ONE_LAW if whole else _LAW_PER_TARGET) if one_law else _SMALL_ROOMS if alike else _MIXED
    else:
        reach = _BROKEN if by_frame else _OBSERVED
    targets: dict[str, dict[str, Any]] = {}
    for j, name in enumerate(TARGET_NAMES):
        targets[name] = {
            "coverage": float(statistics.inside[:, j].mean()),
            "bounded_coverage": _mean(statistics.inside[finite, j]),
            "mean_length": _mean(statistics.length[finite, j]),
            "mean_intervals": float(statistics.n_intervals[:, j].mean()),
        }
        if one_law and not whole:
            low, high = grouped_coverage_band(met, calibration.alpha_per_target)
            inside = low <= targets[name]["coverage"] <= high
            targets[name] |= {"band_99": [low, high], "inside_band": inside}
    return {
        "alpha": float(calibration.alpha),
        "joint": calibration.joint,
        "alpha_per_target": float(calibration.alpha_per_target),
        "score": calibration.score_.name,
        "n_calibration": model.n_calibration,
        "n_evaluated": len(statistics),
        "unbounded": bool(statistics.unbounded[~chosen[EvidenceType.UNKNOWN]].any()),
        **_sizes(statistics),
        # weak ones once more by themselves: that is no guarantee's
        "by_evidence": {
            kind.name.lower(): {
                "frames": int(frames.sum()),
                "calibrated_on": rules.by_type[kind].n_units if kind in rules.by_type else None,
                "joint_coverage": _mean(held[frames]),
                **bounded_coverage(held[frames], finite[frames]),
            }
            for kind, frames in shown.items()
        },
        "by_room": coverage_by_room(held, finite, statistics.rooms),
        "targets": targets,
        "joint_coverage": float(held.mean()),
        "joint_band_99": list(grouped_coverage_band(met, calibration.alpha)) if one_law and whole else None,
        "regions_from": f"one belief from {' + '.join(source.name for source in model.localizer.sources)}",
        "assumption": f"{describe_guarantee(model)} {reach}",
    }


def path_coverage_table(
    statistics: dict[str, RegionStatistics],
    model: PoseModel,
    online: Trajectory,
    truth: Trajectory,
    reliable: BoolArray,
) -> dict[str, Any]:
    """Coverage and size of the regions from posteriors, by the frames that these rest on.

    `online` and `truth` are the poses that a robot got and the true ones, `reliable` whether each counted as reliable.
    """
    table: dict[str, Any] = {
        path: {"coverage": float(regions.held.mean()), **_sizes(regions)} for path, regions in statistics.items()
    }
    if ONLINE in statistics:
        missed = reliable & ~statistics[ONLINE].held
        wrong = reliable & ~same_place(online, truth.positions_xyz, truth.orientations_quat_wxyz, model.prior)
        counts = {"n_reliable": reliable, "n_reliable_and_missed": missed, "n_reliable_and_elsewhere": missed & wrong}
        table |= {name: int(which.sum()) for name, which in counts.items()} | {"n_evaluated": len(reliable)}
    table["assumption"] = _PATHS_OF_FRAMES if model.calibration.units_ is None else _PATHS_OF_UNITS
    return table


def _sizes(regions: RegionStatistics) -> dict[str, Any]:
    """How many regions are bounded, and how large these are."""
    n = regions.n_places[regions.bounded]
    return {
        "abstained": float((~regions.bounded).mean()),
        **bounded_coverage(regions.held, regions.bounded),
        "mean_places": _mean(n),
        "most_places": int(n.max()) if n.size else None,
        "median_length_m": [finite_or_none(x) for x in np.median(regions.length[:, :3], axis=0)],
    }


def bounded_coverage(held: BoolArray, bounded: BoolArray) -> dict[str, Any]:
    """How many regions are bounded, and the coverage of these: an unbounded region holds the truth whatever it is."""
    return {"n_bounded": int(bounded.sum()), "bounded_coverage": _mean(held[bounded])}


def coverage_by_room(held: BoolArray, bounded: BoolArray, rooms: IntArray) -> list[dict[str, Any]]:
    """Coverage of n frames by the room of each; empty where all are of one room.

    That whose bounded regions hold the fewest poses comes first.
    """
    parts = {room: rooms == room for room in np.unique(rooms).tolist()}
    rows = [
        {"room": room, "frames": int(part.sum()), "coverage": float(held[part].mean())}
        | bounded_coverage(held[part], bounded[part])
        for room, part in parts.items()
    ]
    least_first = sorted(rows, key=lambda row: 2.0 if row["bounded_coverage"] is None else row["bounded_coverage"])
    return least_first if len(rows) > 1 else []


def _mean(values: BoolArray | FloatArray | IntArray) -> float | None:
    return float(values.mean()) if values.size else None
