"""All checks of one calibration on test samples; printed, they are a report."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal.calibrators.base import Joint
from conformodal.conformal.calibrators.mondrian import MondrianConformal
from conformodal.conformal.calibrators.split import SplitConformal
from conformodal.conformal.checks import Alpha, Probabilities, as_targets, brief
from conformodal.conformal.errors import ConformodalError
from conformodal.conformal.regions import Regions
from conformodal.core.words import counted

from .coverage import CoverageCheck, check_coverage, coverage_by_group, coverage_by_size, grouped_coverage_band
from .slab import worst_slab

_ASSUMPTION = (
    "A band holds if the calibration and test samples{of_each_group} are exchangeable (split at random, say), neither "
    "was learnt from, and scores have no ties. Even then coverage lies outside its {level} band with probability up to "
    "{chance}{of_any}. Outside, at least one of these assumptions is likely violated. For samples in a sequence, such "
    "as frames of a video, coverage is an observation, not a guarantee."
)
_NOT_BY_PARTS = (
    " Nothing is guaranteed for a size, a group or a slab by itself: outside its band, sets are too small (BELOW) or "
    "too large (above) in this part by more than chance explains; for groups, MondrianConformal mends that."
)


@dataclass(frozen=True)
class SizeSummary:
    """Sizes of one target's sets."""

    mean: float  # length in the target's unit, inf if a set is unbounded
    median: float
    q90: float
    intervals: float  # mean number of disjoint intervals
    split: float  # share of the sets with more than one interval
    empty: float
    unbounded: float


def summarise_sizes(regions: Regions) -> list[SizeSummary]:
    """One summary per target."""
    if len(regions) == 0:
        raise ConformodalError("regions must hold at least one sample to be summarised")
    at = [int(np.ceil(q * len(regions))) - 1 for q in (0.5, 0.9)]
    counts, lengths = regions.n_intervals, regions.length
    columns = (
        lengths.mean(axis=0),
        *np.sort(lengths, axis=0)[at],
        counts.mean(axis=0),
        (counts > 1).mean(axis=0),
        (counts == 0).mean(axis=0),
        regions.unbounded.mean(axis=0),
    )
    return [SizeSummary(*map(float, values)) for values in zip(*columns, strict=True)]


@dataclass(frozen=True)
class ColumnDiagnosis:
    """Checks of one coverage guarantee: of one target, or with ``joint="max"`` of all together."""

    name: str  # of the target, or "all targets"
    coverage: CoverageCheck  # of all test samples
    by_size: dict[str, CoverageCheck]
    by_group: dict[str, CoverageCheck]  # empty without groups
    slab: CoverageCheck | None  # of the worst slab of the inputs, on other samples; None without inputs

    def rows(self) -> list[tuple[str, CoverageCheck]]:
        """All coverages, each with its label."""
        return [
            ("all samples", self.coverage),
            *((f"size {name}", check) for name, check in self.by_size.items()),
            *((f"group {name}", check) for name, check in self.by_group.items()),
            *([] if self.slab is None else [("worst slab, other samples", self.slab)]),
        ]


@dataclass(frozen=True)
class Diagnosis:
    """Result of :func:`diagnose`; ``print`` it for the report.

    Attributes
    ----------
    columns
        One entry for each coverage guarantee.
    names, sizes
        The targets' names and the sizes of their sets.
    joint_coverage
        Share of test samples whose targets are all in their sets.
    alpha, joint, score, n_calibration, n_test
        Of the calibration and the test.
    within_groups
        Whether coverage is guaranteed within each group.
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
    within_groups: bool = False

    def __str__(self) -> str:
        lines = [
            f"Conformal sets at alpha = {self.alpha}: score {self.score}, joint {self.joint}; "
            f"{self.n_calibration} calibration and {counted(self.n_test, 'test sample')}.",
            "",
        ]
        width = max([12, *map(len, self.names)])
        lines.append(f"{'sets':{width}}  mean length  median  90th pct  intervals  split  empty  whole line")
        for name, s in zip(self.names, self.sizes, strict=True):
            lines.append(
                f"{name:{width}}  {s.mean:11.4g}  {s.median:6.4g}  {s.q90:8.4g}  {s.intervals:9.2f}  "
                f"{_percent(s.split):>5}  {_percent(s.empty):>5}  {_percent(s.unbounded):>10}"
            )
        for column in self.columns:
            lines += ["", *_table(column)]
        if len(self.names) > 1 and self.joint != "max":  # with max, the coverage above is of all targets
            least = "" if self.joint == "none" else f" (guaranteed on average: at least {1 - float(self.alpha):.4g})"
            lines += ["", f"All {len(self.names)} targets held at once: {self.joint_coverage:.3f}{least}."]
        level, n_bands = self.columns[0].coverage.level, len(self.columns)
        of_any = f" (one of {n_bands}: up to {min(1.0, n_bands * (1 - level)):.2g})" if n_bands > 1 else ""
        assumption = _ASSUMPTION.format(
            of_each_group=" of each group" if self.within_groups else "",
            level=f"{100 * level:g} %",
            chance=f"{1 - level:.2g}",
            of_any=of_any,
        )
        caveat = assumption if self.within_groups else assumption + _NOT_BY_PARTS
        return "\n".join([*lines, "", *textwrap.wrap(caveat, 110)])


def _percent(share: float) -> str:
    return "<1%" if 0 < share < 0.005 else f"{share:.0%}"


def _table(column: ColumnDiagnosis) -> list[str]:
    rows = column.rows()
    width = max(len(label) for label, _ in rows)
    level = f"{100 * column.coverage.level:g}%"
    lines = [f"coverage of {column.name}", f"  {'':{width}}  samples  coverage  {level} band"]
    for label, c in rows:
        mark = "within" if c.inside else "BELOW" if c.coverage < c.low else "above"
        lines.append(f"  {label:{width}}  {c.n_test:7d}  {c.coverage:8.3f}  [{c.low:.3f}, {c.high:.3f}]  {mark}")
    return lines


def diagnose(
    calibrator: SplitConformal | MondrianConformal,
    proba: Probabilities,
    y: npt.ArrayLike,
    X: npt.ArrayLike | None = None,
    groups: npt.ArrayLike | None = None,
    names: Sequence[str] | None = None,
    level: float = 0.99,
    random_state: Any = 0,
) -> Diagnosis:
    """Check a calibration on test samples that it has not seen.

    Parameters
    ----------
    calibrator
        Calibrated.
    proba, y
        Of the test samples: (n, d, K) or a list of d arrays (n, K_d); true values (n, d), or (n,) for one target.
    X
        (n, p) inputs, to search for the worst slab.
    groups
        (n,) labels, to check group by group. A :class:`~conformodal.conformal.MondrianConformal` needs them: bands are
        then those of its groups, and neither sizes nor slabs are checked.
    names, level, random_state
        Names of the targets, probability of every band, and seed of the slab search.

    Examples
    --------
    >>> import numpy as np
    >>> from conformodal.conformal import QuantileBins, SplitConformal, diagnose
    >>> y = np.random.default_rng(0).normal(size=2000)
    >>> bins = QuantileBins(20).fit(y[:1000])
    >>> proba = np.full((500, 20), 1 / 20)  # of a classifier that has learnt nothing
    >>> calibrator = SplitConformal(bins, alpha=0.1, score="density").calibrate(proba, y[1000:1500])
    >>> diagnose(calibrator, proba, y[1500:]).columns[0].coverage.inside
    True
    """
    if isinstance(calibrator, MondrianConformal):
        if groups is None:
            raise ConformodalError("groups are needed to check a MondrianConformal")
        regions = calibrator.predict(proba, groups)
    elif isinstance(calibrator, SplitConformal):
        regions = calibrator.predict(proba)
    else:
        hint = "for others, check_coverage takes what their regions contain"
        raise ConformodalError(
            f"calibrator must be Split- or MondrianConformal, got {type(calibrator).__name__}; {hint}"
        )
    values = as_targets(y, n_targets=calibrator.bins.n_targets)
    if values.shape[0] == 0:
        raise ConformodalError("y must hold at least one test sample")
    inside, given = regions.contains(values), names
    if given is None:
        given = calibrator.bins.names or [f"target {j}" for j in range(inside.shape[1])]
    targets = tuple(map(str, given if isinstance(given, Iterable) and not isinstance(given, str) else []))
    if len(targets) != inside.shape[1]:
        raise ConformodalError(f"names must hold one name per target ({inside.shape[1]}), got {brief(given)}")
    guarantees = zip(targets, inside.T, regions.length.T, strict=True)
    if calibrator.joint == "max":
        guarantees = zip(["all targets"], [inside.all(axis=1)], [regions.volume], strict=True)
    n_calibration = len(calibrator.scores_)
    law: Any = {"n_calibration": n_calibration, "alpha": calibrator.alpha_per_target, "level": level}
    columns = []
    for name, held, size in guarantees:
        whole = check_coverage(held, **law)
        if isinstance(calibrator, MondrianConformal) and groups is not None:
            by_group = coverage_by_group(held, groups, calibrator.sizes_, law["alpha"], level)
            pairs = [(check.n_calibration, check.n_test) for check in by_group.values()]
            low, high = grouped_coverage_band(pairs, law["alpha"], level)
            columns.append(ColumnDiagnosis(name, replace(whole, low=low, high=high), {}, by_group, None))
            continue
        by_size = coverage_by_size(held, size, **law)
        by_group = {} if groups is None else coverage_by_group(held, groups, **law)
        slab = None if X is None or len(held) < 2 else worst_slab(held, X, **law, random_state=random_state)
        columns.append(ColumnDiagnosis(name, whole, by_size, by_group, slab))
    sizes, together = tuple(summarise_sizes(regions)), float(inside.all(axis=1).mean())
    about = calibrator.alpha, calibrator.joint, calibrator.score_.name
    within = isinstance(calibrator, MondrianConformal)
    return Diagnosis(tuple(columns), targets, sizes, together, *about, n_calibration, len(values), within)
