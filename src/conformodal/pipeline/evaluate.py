"""Evaluation of a run: errors of every method, and coverage of the regions with its exact band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from conformodal.conformal import SplitConformal, grouped_coverage_band
from conformodal.core.arrays import BoolArray, FloatArray, IntArray, Rows
from conformodal.core.words import finite_or_none
from conformodal.geometry import Trajectory, trajectory_errors
from conformodal.localizer.candidates import TARGET_NAMES, pose_targets
from conformodal.localizer.observations import same_place
from conformodal.localizer.radius import PoseRadius
from conformodal.localizer.regions import EvidenceType, PoseRegions

from .model import ONLINE, PoseModel, SourceComparison

_ASSUMPTION_HELD = (
    "Frames were split at random, so calibration and test frames are exchangeable: the covered count of each "
    "evidence type follows a Beta-binomial law, and the central 99 % of their sum is the band."
)
_ASSUMPTION_EACH = (
    "Frames were split at random, so calibration and test frames are exchangeable: for each evidence type the "
    "covered count of a target follows a Beta-binomial law, and the central 99 % of their sum is the target's band. "
    "For the whole pose there is no exact law."
)
_ASSUMPTION_MIXED = (
    "Frames were split at random, so calibration and test frames are exchangeable, and the guarantee holds. "
    "Some images are blurred, dark, bright or noisy as no training image is. Copies that were disturbed at random "
    "calibrate their regions, so there is no exact band for the count."
)
_ASSUMPTION_STRETCHES = (
    "Thresholds are those of whole stretches (or recordings), answered by sources that had not seen them. The "
    "guarantee is about a frame drawn at random from a new stretch, if stretches are exchangeable and the "
    "nonconformity scores of the sources, which now know all of them, are no larger than those of "
    "sources that lacked some; smaller errors are not enough. Where stretches calibrate, other stretches of the same "
    "recording were known: the guarantee does not reach a recording of which nothing was known. Coverage here is an "
    "observation."
)
_PATHS_BY_STRETCH = (
    "Regions from posteriors are calibrated on held-out stretches (or recordings), each run as a stream from its first "
    "frame by sources that had not seen it. The guarantee is about a frame drawn at random from a new stretch that is "
    "run so."
)
_PATHS_BY_FRAME = (
    "Regions from posteriors are calibrated on the calibration frames, run as a stream with gaps. Other frames make "
    "other gaps, so their guarantee is approximate."
)
_ASSUMPTION_SEEN = (
    "The sources of the regions learnt from these frames, or were calibrated on them: coverage here says nothing about "
    "new ones."
)
_ASSUMPTION_BROKEN = (
    "The evaluated frames are not the ones, or not all of them, that were held out at random, one by one, together "
    "with the calibration frames, so the two are not exchangeable: coverage here is an observation, and no guarantee "
    "applies."
)


@dataclass(frozen=True, eq=False)
class RegionStatistics(Rows):
    """Statistics of the regions of n frames, target by target, (n, 7) each."""

    inside: BoolArray  # whether the set holds the truth
    length: FloatArray  # of the set, in the target's unit; infinite for the whole line
    n_intervals: IntArray  # that the set falls into
    unbounded: BoolArray  # whether it is the whole line
    # (n,) what each region rests on, see :class:`~conformodal.localizer.regions.EvidenceType`
    kinds: IntArray
    held: BoolArray  # (n,) whether the region holds the whole pose
    n_places: IntArray  # (n,) cuboids that it consists of

    @property
    def bounded(self) -> BoolArray:
        """(n,) whether the set of every target is bounded."""
        return np.asarray(~self.unbounded.any(axis=1))

    def __len__(self) -> int:
        return len(self.inside)

    @classmethod
    def of(
        cls, regions: PoseRegions, truth: Trajectory, sign_reference: FloatArray, kinds: IntArray | None = None
    ) -> RegionStatistics:
        """Statistics of the regions of frames whose poses are known; `kinds` says what each rests on."""
        kinds = np.full(len(regions), EvidenceType.GLOBAL, dtype=np.int64) if kinds is None else kinds
        targets = pose_targets(truth, sign_reference)
        inside, held = regions.contains(targets), regions.contains(targets, joint=True)
        return cls(inside, regions.length, regions.n_intervals, regions.unbounded, kinds, held, regions.n_places)


def error_table(trajectories: dict[str, Trajectory], truth: Trajectory) -> dict[str, dict[str, float]]:
    """``rmse_m``, ``rmse_deg`` and medians of every trajectory, by its name: first of the one that a robot gets."""
    ordered = sorted(trajectories, key=lambda name: name != ONLINE)
    return {name: trajectory_errors(trajectories[name], truth) for name in ordered}


def coverage_table(
    statistics: RegionStatistics, model: PoseModel, *, exchangeable: bool, seen: bool = False
) -> dict[str, Any]:
    """Coverage and size of the regions of the frames that were answered.

    Parameters
    ----------
    statistics, model
        Of these regions, and what calibrated them.
    exchangeable
        Whether the frames are exchangeable with the calibration frames: the test part of an ``interleaved`` split.
    seen
        Whether they are of the training or the calibration part.
    """
    held, finite = statistics.held, statistics.bounded
    rules = model.rules
    kinds = [(kind, rule, int((statistics.kinds == kind).sum())) for kind, rule in rules.by_type.items()]
    met = [(rule.n_units, count) for _, rule, count in kinds if count]
    met += [(0, int((statistics.kinds == EvidenceType.UNKNOWN).sum()))]  # always covered
    by_frame = rules.overall.units_ is None
    one_law = exchangeable and by_frame
    # those that left the range of qualities by chance are not exchangeable with disturbed ones
    one_law = one_law and not (statistics.kinds == EvidenceType.DISTURBED).any()
    calibration = model.calibration
    whole = calibration.joint == "max"
    band = grouped_coverage_band(met, calibration.alpha) if one_law and whole else None
    each = met if one_law and not whole else None
    names = " + ".join(source.name for source in model.localizer.sources)
    return {
        "alpha": float(calibration.alpha),
        "joint": calibration.joint,
        "alpha_per_target": float(calibration.alpha_per_target),
        "score": calibration.score_.name,
        "n_calibration": model.n_calibration,
        "n_evaluated": len(statistics),
        "unbounded": bool(statistics.unbounded[statistics.kinds != EvidenceType.UNKNOWN].any()),
        "abstained": float((~finite).mean()),
        **bounded_coverage(held, finite),
        "by_evidence": {
            kind.name.lower(): {
                "frames": count,
                "calibrated_on": rule.n_units,
                "joint_coverage": float(held[statistics.kinds == kind].mean()) if count else None,
                **bounded_coverage(held[statistics.kinds == kind], finite[statistics.kinds == kind]),
            }
            for kind, rule, count in kinds
        },
        "targets": {name: _target_row(statistics, j, calibration, each) for j, name in enumerate(TARGET_NAMES)},
        "joint_coverage": float(held.mean()),
        "joint_band_99": None if band is None else list(band),
        **places_row(statistics),
        "by_size": coverage_by_size(statistics),
        "median_length_m": [finite_or_none(x) for x in np.median(statistics.length[:, :3], axis=0)],
        "median_position_volume_m3": finite_or_none(np.median(statistics.length[:, :3].prod(axis=1))),
        "regions_from": f"one belief from {names}",
        "assumption": _assumption(
            exchangeable and by_frame,
            by_frame,
            whole,
            one_law,
            seen,
            comparison=model.comparison,
        ),
    }


def places_row(statistics: RegionStatistics) -> dict[str, Any]:
    """How many places bounded regions consist of."""
    n = statistics.n_places[statistics.bounded]
    return {"mean_places": float(n.mean()) if n.size else None, "most_places": int(n.max()) if n.size else None}


def coverage_by_size(statistics: RegionStatistics) -> list[dict[str, Any]]:
    """Coverage of the whole pose in each tenth of the bounded regions, from the smallest mean length along x, y and z.

    Where regions are sharper than their evidence, the first rows lie below the others. Each has ten frames or more, so
    that fewer than a hundred frames make fewer rows.
    """
    length, held = statistics.length[statistics.bounded, :3].mean(axis=1), statistics.held[statistics.bounded]
    parts = np.array_split(np.argsort(length, kind="stable"), max(1, min(10, len(length) // 10)))
    return [
        {"frames": len(at), "median_length_m": float(np.median(length[at])), "coverage": float(held[at].mean())}
        for at in parts
        if len(at)
    ]


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
    by_frame = model.rules.overall.units_ is None
    table: dict[str, Any] = {
        path: {
            "coverage": float(regions.held.mean()),
            "abstained": float((~regions.bounded).mean()),
            **bounded_coverage(regions.held, regions.bounded),
            **places_row(regions),
            "by_size": coverage_by_size(regions),
            "median_length_m": [finite_or_none(x) for x in np.median(regions.length[:, :3], axis=0)],
        }
        for path, regions in statistics.items()
    }
    if ONLINE in statistics:
        missed = reliable & ~statistics[ONLINE].held
        wrong = reliable & ~same_place(online, truth.positions_xyz, truth.orientations_quat_wxyz, model.prior)
        counts = {"n_reliable": reliable, "n_reliable_and_missed": missed, "n_reliable_and_elsewhere": missed & wrong}
        table |= {name: int(which.sum()) for name, which in counts.items()} | {"n_evaluated": len(reliable)}
    table["assumption"] = _PATHS_BY_FRAME if by_frame else _PATHS_BY_STRETCH
    return table


def bounded_coverage(held: BoolArray, bounded: BoolArray) -> dict[str, Any]:
    """How many regions are bounded, and the coverage of these: an unbounded region holds the truth whatever it is."""
    n = int(bounded.sum())
    return {"n_bounded": n, "bounded_coverage": float(held[bounded].mean()) if n else None}


def _target_row(
    statistics: RegionStatistics, j: int, calibration: SplitConformal, met: list[tuple[int, int]] | None
) -> dict[str, Any]:
    """Coverage and size for one target; with the band of its coverage where `met` counts the frames of each kind."""
    finite = statistics.bounded
    row: dict[str, Any] = {
        "coverage": float(statistics.inside[:, j].mean()),
        "bounded_coverage": float(statistics.inside[finite, j].mean()) if finite.any() else None,
        "mean_length": float(statistics.length[finite, j].mean()) if finite.any() else None,
        "mean_intervals": float(statistics.n_intervals[:, j].mean()),
    }
    if met is not None:
        low, high = grouped_coverage_band(met, calibration.alpha_per_target)
        row |= {"band_99": [low, high], "inside_band": low <= row["coverage"] <= high}
    return row


def _assumption(
    guaranteed: bool,
    by_frame: bool,
    whole: bool,
    one_law: bool,
    seen: bool,
    *,
    comparison: SourceComparison | None,
) -> str:
    """What the coverage rests on, for people."""
    if guaranteed:
        return (_ASSUMPTION_HELD if whole else _ASSUMPTION_EACH) if one_law else _ASSUMPTION_MIXED
    if seen:
        return _ASSUMPTION_SEEN
    if by_frame:
        return _ASSUMPTION_BROKEN
    return _ASSUMPTION_STRETCHES if comparison is None else f"{_ASSUMPTION_STRETCHES} {comparison.describe()}."


def radius_table(
    radius: PoseRadius | None,
    trajectories: dict[str, Trajectory],
    truth: Trajectory | None,
    frames: IntArray | None = None,
) -> dict[str, Any] | None:
    """The chosen pose's radius, what it guarantees, and how many frames it held if the truth of `frames` is known."""
    if radius is None:
        return None
    estimate = trajectories[radius.method]
    of = np.arange(len(estimate)) if frames is None else frames
    held = None if truth is None else float(radius.holds(estimate[of], truth).mean())
    return {
        "radius_m": finite_or_none(radius.radius_m),
        "radius_deg": finite_or_none(radius.radius_deg),
        "alpha": radius.alpha,
        "guarantee": str(radius.guarantee),
        "method": radius.method,
        "n_recordings": radius.n_recordings,
        "share_held": held,
        "assumption": radius.assumption,
    }


def is_exchangeable(model: PoseModel, part: str | None) -> bool:
    """Whether the guarantee reaches a part, if all its frames are answered: only the test part of single frames."""
    return part == "test" and model.frames_are_exchangeable
