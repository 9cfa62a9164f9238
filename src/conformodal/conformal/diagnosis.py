"""All checks of one calibration on test samples; printed, they are a report."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import BoolArray
from conformodal.core.errors import ConformodalError
from conformodal.core.words import counted, readable

from .calibrators.base import Joint
from .calibrators.mondrian import MondrianConformal
from .calibrators.split import SplitConformal
from .checks import SHARE, Alpha, Probabilities, as_labels, as_targets, check_number, factorise
from .coverage import CoverageCheck, check_coverage, grouped_coverage_band
from .regions import Regions

_ASSUMPTION = (
    "{bands} if the calibration and test samples{of_each_group} are exchangeable (split at random, say), neither was "
    "learnt from, and scores have no ties. Outside, at least one of these assumptions is likely violated. For samples "
    "in a sequence, such as frames of a video, coverage is an observation, not a guarantee."
)
_OF_UNITS = (
    "Units calibrate, so that rows are not exchangeable one by one: a random row of a new unit is covered with the "
    "probability asked for, and there is no exact band. With {units} the coverage of one test varies more than with as "
    "many single rows, most where rows of a unit are alike."
)
_NOT_BY_GROUP = (
    " Nothing is guaranteed for a group by itself: outside its band, its sets are too small (BELOW) or too large "
    "(above) by more than chance explains; MondrianConformal mends that."
)
_EMPTY = (
    " An empty set counts as a miss: no value of its row is as likely as a set demands; the best guess is `predict`."
)
_SHOWN = 10  # groups, the furthest below their bands first


@dataclass(frozen=True)
class SizeSummary:
    """Sizes of one target's sets."""

    mean: float  # length of the bounded sets in the target's unit; inf if there are none
    median: float
    q90: float
    intervals: float  # mean number of disjoint intervals
    split: float  # share of the sets with more than one interval
    empty: float
    unbounded: float


def summarise_sizes(regions: Regions) -> list[SizeSummary]:
    """One summary per target."""
    at = [int(np.ceil(q * len(regions))) - 1 for q in (0.5, 0.9)]
    counts, lengths = regions.n_intervals, regions.length
    ranked = np.sort(lengths, axis=0)[at]
    shares = [(counts > 1).mean(axis=0), (counts == 0).mean(axis=0), regions.unbounded.mean(axis=0)]
    bounded = ~regions.unbounded
    total = np.where(bounded, lengths, 0).sum(axis=0)
    means = np.divide(total, bounded.sum(axis=0), out=np.full(total.shape, np.inf), where=bounded.any(axis=0))
    columns = np.array([means, *ranked, counts.mean(axis=0), *shares])
    return [SizeSummary(*values) for values in columns.T.tolist()]


@dataclass(frozen=True)
class ColumnDiagnosis:
    """Checks of one coverage guarantee: of one target, or with ``joint="max"`` of all together."""

    name: str  # of the target, or "all targets"
    coverage: CoverageCheck  # of all test samples
    parts: dict[str, CoverageCheck]  # of groups

    def rows(self) -> list[tuple[str, CoverageCheck]]:
        """The coverage of all samples and of each group with its label: of many, the ten that cover least.

        Groups that cover 1 of a band that is 1 alone, as those of unbounded sets, come last.
        """
        over = {
            label: (check.coverage == check.low == 1, check.coverage - check.low) for label, check in self.parts.items()
        }
        ranked = sorted(over, key=lambda label: over[label])
        shown = self.parts if len(ranked) <= _SHOWN + 1 else ranked[:_SHOWN]
        return [("all samples", self.coverage), *((label, self.parts[label]) for label in shown)]

    def rest(self) -> str:
        """What :meth:`rows` leaves out, in words; nothing if that is nothing."""
        shown = dict(self.rows())
        others = [check for label, check in self.parts.items() if label not in shown]
        inside = sum(check.inside for check in others)
        return f"{len(others)} others: {inside} within their bands" if others else ""


@dataclass(frozen=True)
class Diagnosis:
    """Result of :func:`diagnose`; ``print`` it for the report.

    Attributes
    ----------
    columns : one entry for each coverage guarantee
    names, sizes : the targets' names, and summaries of the sizes of their sets
    joint_coverage : share of test samples whose targets are all in their sets
    alpha, joint, score, n_calibration, n_test : of the calibration and the test
    n_units : of the units that calibrate; None where single samples do. With units no band is exact, and all are 0 to 1
    within_groups : whether coverage is guaranteed within each group
    level : probability with which all bands hold at once
    """

    columns: tuple[ColumnDiagnosis, ...]
    names: tuple[str, ...]
    sizes: tuple[SizeSummary, ...]
    joint_coverage: float
    alpha: Alpha
    joint: Joint
    score: str
    n_calibration: int
    n_test: int
    within_groups: bool
    level: float
    n_units: int | None = None

    @property
    def n_bands(self) -> int:
        """Number of all bands."""
        return sum(1 + len(column.parts) for column in self.columns)

    def __str__(self) -> str:
        of_units = "" if self.n_units is None else f" (of {counted(self.n_units, 'unit')})"
        lines = [
            f"Conformal sets at alpha = {self.alpha}: score {self.score}, joint {self.joint}; "
            f"{self.n_calibration} calibration{of_units} and {counted(self.n_test, 'test sample')}.",
            "",
        ]
        width = max([12, *map(len, self.names)])
        lines.append(f"{'sets':{width}}  mean length     median   90th pct  intervals  split  empty  unbounded")
        for name, s in zip(self.names, self.sizes, strict=True):
            mean, median, q90 = map(readable, (s.mean, s.median, s.q90))
            lines.append(
                f"{name:{width}}  {mean:>11}  {median:>9}  {q90:>9}  {s.intervals:9.2f}  "
                f"{_percent(s.split):>5}  {_percent(s.empty):>5}  {_percent(s.unbounded):>9}"
            )
        if any(0 < s.unbounded < 1 for s in self.sizes):
            lines.append("The mean length is that of the bounded sets.")
        for column in self.columns:
            lines += ["", *_table(column, self.level if self.n_units is None else None)]
        if len(self.names) > 1 and self.joint != "max":  # with max, the coverage above is of all targets
            least = "" if self.joint == "none" else f" (guaranteed on average: at least {1 - float(self.alpha):.4g})"
            lines += ["", f"All {len(self.names)} targets held at once: {self.joint_coverage:.3f}{least}."]
        bands = f"All {self.n_bands} bands hold at once" if self.n_bands > 1 else "The band holds"
        caveat = _ASSUMPTION.format(
            bands=f"{bands} with probability {100 * self.level:g} %",
            of_each_group=" of each group" if self.within_groups else "",
        )
        if self.n_units is not None:
            caveat = _OF_UNITS.format(units=counted(self.n_units, "unit"))
        grouped = self.n_units is None and any(column.parts for column in self.columns)
        caveat += _NOT_BY_GROUP * (grouped and not self.within_groups) + _EMPTY * any(s.empty for s in self.sizes)
        return "\n".join([*lines, "", *textwrap.wrap(caveat, 110)])


def _percent(share: float) -> str:
    return "<1%" if 0 < share < 0.005 else f"{share:.0%}"


def _table(column: ColumnDiagnosis, level: float | None) -> list[str]:
    """Lines of the coverage of all samples and of groups; with the bands of a level, if there are some."""
    rows = column.rows()
    width = max(len(label) for label, _ in rows)
    heading = "" if level is None else f"  {100 * level:g}% band"
    lines = [f"coverage of {column.name}", f"  {'':{width}}  samples  coverage{heading}"]
    for label, c in rows:
        mark = "within" if c.inside else "BELOW" if c.coverage < c.low else "above"
        band = "" if level is None else f"  [{c.low:.3f}, {c.high:.3f}]  {mark}"
        lines.append(f"  {label:{width}}  {c.n_test:7d}  {c.coverage:8.3f}{band}")
    return [*lines, *filter(None, [column.rest()])]


def diagnose(
    calibrator: SplitConformal | MondrianConformal,
    proba: Probabilities,
    y: npt.ArrayLike,
    groups: npt.ArrayLike | None = None,
    level: float = 0.99,
    regions: Regions | None = None,
) -> Diagnosis:
    """Check a calibration on test samples that it has not seen; for an example see ``docs/tutorial.md``.

    Parameters
    ----------
    calibrator
        Calibrated.
    proba, y
        Of the test samples: (n, d, K) or a list of d arrays (n, K_d); true values (n, d), or (n,) for one target.
    groups
        (n,) labels, to check group by group. A :class:`~conformodal.conformal.MondrianConformal` needs them: bands are
        then those of its groups.
    level
        Probability with which all bands hold at once, by Bonferroni's inequality.
    regions
        Of the test samples, if they are others than the calibrator's: rows of a kind never learnt are unbounded.
    """
    values = as_targets(y, n_targets=calibrator.bins.n_targets)
    n_units = None
    if isinstance(calibrator, SplitConformal):
        n_units = None if calibrator.units_ is None else calibrator.n_units
        regions = calibrator.predict(proba) if regions is None else regions
    elif groups is None:
        raise ConformodalError("groups are needed to check a MondrianConformal")
    elif regions is None:
        regions = calibrator.predict(proba, groups)
    inside = regions.contains(values)
    names = tuple(calibrator.bins.target_names)
    guarantees = zip(names, inside.T, strict=True)
    if calibrator.joint == "max":
        guarantees = zip(["all targets"], [inside.all(axis=1)], strict=True)
    labels, codes = ([], None) if groups is None else factorise(as_labels(groups, len(values)))
    n_bands = (1 if calibrator.joint == "max" else len(names)) * (1 + len(labels))
    each = 1 - (1 - check_number(level, "level", SHARE)) / n_bands
    columns = tuple(_column(calibrator, *guarantee, labels, codes, each) for guarantee in guarantees)
    return Diagnosis(
        columns,
        names,
        tuple(summarise_sizes(regions)),
        float(inside.all(axis=1).mean()),
        calibrator.alpha,
        calibrator.joint,
        calibrator.score_.name,
        len(calibrator.scores_),
        len(values),
        isinstance(calibrator, MondrianConformal),
        level,
        n_units,
    )


def _column(
    calibrator: Any, name: str, held: BoolArray, labels: list[Any], codes: Any, level: float
) -> ColumnDiagnosis:
    """Checks of a guarantee on test samples (n,), each beside a band of probability `level`."""
    n_calibration, law = len(calibrator.scores_), (calibrator.alpha_per_target, level)
    whole = check_coverage(held, n_calibration, *law)
    of_group = getattr(calibrator, "sizes_", dict.fromkeys(labels, n_calibration))
    by_group = {
        f"group {label}": check_coverage(held[codes == k], of_group.get(label, 0), *law)
        for k, label in enumerate(labels)
    }
    # where units calibrate, the law of exchangeable samples does not apply
    if isinstance(calibrator, SplitConformal) and calibrator.units_ is not None:
        by_group = {label: replace(check, low=0.0, high=1.0) for label, check in by_group.items()}
        return ColumnDiagnosis(name, replace(whole, low=0.0, high=1.0), by_group)
    if isinstance(calibrator, MondrianConformal):
        pairs = [(check.n_calibration, check.n_test) for check in by_group.values()]
        low, high = grouped_coverage_band(pairs, *law)
        return ColumnDiagnosis(name, replace(whole, low=low, high=high), by_group)
    return ColumnDiagnosis(name, whole, by_group)
