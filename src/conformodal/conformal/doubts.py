"""Doubts about rows: new ones unlike those learnt from, and ones whose coverage is not that of later rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np
from scipy.special import bdtr, bdtrc
from scipy.stats import rankdata
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.model_selection import GroupKFold

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from conformodal.core.errors import ConformodalError
from conformodal.core.words import counted

from .density.encoder import columns_of, columns_where, dense_inputs, has_zone, is_frame, is_time
from .density.named import most_correlated
from .scores import row_uniforms

Unlike = Literal["unbounded", "ignore"]

# told is what is no more likely than this, if new rows are like the training rows, and what lies ranges beyond a range
_CHANCE, _FAR = 1e-3, 10.0
# rows of a forest that stands for the learner
_MOST_ROWS = 1000
# told are units and last rows of which sets for 90 % hold less, and orders in which errors of neighbours correlate more
_LEAST_HELD, _LEAST_HELD_LATER, _ALIKE = 0.72, 0.8, 0.6


class DataWarning(UserWarning):
    """Rows that are unlike each other in a way that coverage does not hold for, and what to do."""


def _chance(rows: BoolArray, share: float) -> float:
    """Probability of so many rows or more, of which each is one with probability `share`."""
    return float(bdtrc(rows.sum() - 1, rows.size, share)) if rows.any() else 1.0


@dataclass
class ColumnMemory:
    """What one column held: rows, rows without a value, the range of numbers, how often each label, dates, a zone."""

    n: int = 0
    n_missing: int = 0
    low: float = np.inf
    high: float = -np.inf
    labels: dict[str, int] = field(default_factory=dict)
    dated: bool = False
    zone: bool = False

    def learn(self, values: Any) -> None:
        """Take in more rows of the column."""
        present = values[~_missing(values)]
        self.n, self.n_missing = self.n + len(values), self.n_missing + len(values) - len(present)
        if values.dtype.kind == "f":
            self.low, self.high = float(present.min(initial=self.low)), float(present.max(initial=self.high))
        else:
            for label, count in zip(*np.unique(present, return_counts=True), strict=True):
                self.labels[str(label)] = self.labels.get(str(label), 0) + int(count)

    def compare(self, values: Any, name: object) -> tuple[BoolArray, list[str]]:
        """Whether each value is of a kind that never occurred, and what is not chance, in words."""
        gaps, words = _missing(values), list[str]()
        unlike = gaps & (self.n_missing == 0)
        if self.n_missing == self.n or (values.dtype.kind == "f" and self.labels):
            return unlike & False, words
        if unlike.any() or _chance(gaps, self.n_missing / self.n) < _CHANCE:
            words.append(f"{name} is missing in {gaps.sum()}, in training in {self.n_missing} of {self.n}")
        if values.dtype.kind == "f":
            outside = ~gaps & ((values < self.low) | (values > self.high))
            far = np.abs(values - (self.low + self.high) / 2) > _FAR * (self.high - self.low)
            # later dates are what new rows have
            if (outside & far).any() or (not self.dated and _chance(outside, 2 / (self.n + 1)) < _CHANCE**2):
                ends = [np.datetime64(int(end), "D") if self.dated else f"{end:.6g}" for end in (self.low, self.high)]
                words.append(f"{name} is beyond {ends[0]} to {ends[1]}, its range, in {outside.sum()}")
            return unlike, words
        new = ~gaps & ~np.isin(values, list(self.labels))
        once = sum(count == 1 for count in self.labels.values())  # of n: the chance of a new label (Good 1953)
        if _chance(new, once / self.n) < _CHANCE:
            label = str(values[new][0])
            same = [old for old in self.labels if old.strip().casefold() == label.strip().casefold()]
            hint = f", which may be {same[0]!r}" if same else ""
            words.append(f"{name} has a label that is new in {new.sum()}, such as {label!r}{hint}")
        return unlike | (new & (once == 0)), words


class TableMemory:
    """What the columns of a table held, to tell new rows that are unlike its rows."""

    def __init__(self) -> None:
        self.columns: list[ColumnMemory] = []

    def learn(self, X: Any) -> Self:
        """Take in the rows of a table; what is not a table of numbers, text and dates is passed over."""
        columns = _columns(X)
        self.columns = self.columns or [ColumnMemory() for _ in columns]
        zoned, dated = columns_where(X, has_zone), columns_where(X, is_time)
        for j, (memory, values) in enumerate(zip(self.columns, columns, strict=len(columns) > 0)):
            memory.learn(values)
            memory.dated, memory.zone = j in dated, j in zoned
        return self

    def compare(self, X: Any) -> tuple[BoolArray, str]:
        """Rows (n,) with a label, or a missing value, where none occurred, and a warning or nothing."""
        unlike, words = np.zeros(X.shape[0], dtype=np.bool_), list[str]()
        texts = [j for j, memory in enumerate(self.columns) if memory.labels]
        zoned, names = columns_where(X, has_zone), _names(X)
        for j, (memory, values) in enumerate(zip(self.columns, _columns(X, texts), strict=False)):
            rows, told = memory.compare(values, names[j])
            unlike, words = unlike | rows, words + told
            if memory.zone != (j in zoned):
                words.append(f"{names[j]} had {'a' if memory.zone else 'no'} time zone in training")
        return unlike, f"of {counted(len(unlike), 'row')}: {'; '.join(words)}" if words else ""


def _missing(values: Any) -> BoolArray:
    return np.asarray(np.isnan(values) if values.dtype.kind == "f" else values == "")


def _names(X: Any) -> list[str]:
    return [str(name) for name in X.columns] if is_frame(X) else [f"column {j}" for j in range(X.shape[1])]


def _columns(X: Any, text: Any = ()) -> list[Any]:
    try:
        return [] if hasattr(X, "tocsr") else columns_of(X, text)
    except (ConformodalError, ValueError, TypeError):
        return []


def doubt_rows(X: Any, y: FloatArray, has_units: bool, in_time: bool) -> list[str]:
    """Why the coverage of rows split at random is not that of new rows, and what mends it, in words.

    `y` are values (n, d). Looked for are identical rows; units with several rows, such as a subject; and an order in
    which neighbours are alike, that of the index or of the first column of dates.
    """
    columns, matrix = _columns(X), dense_inputs(X)
    if len(y) < 40 or matrix is None or not columns:  # of fewer rows any are alike
        return []
    z = (y - y.mean(axis=0)) / np.maximum(y.std(axis=0), 1e-300)
    matrix = matrix[:, most_correlated(matrix, z, 100)]
    words = [] if has_units else _doubt_units(X, columns, matrix, z)
    return words if in_time else words + _doubt_order(X, columns, matrix, z)


def _doubt_units(X: Any, columns: list[Any], matrix: FloatArray, z: FloatArray) -> list[str]:
    """Rows that are identical, and the column whose values name what rows were drawn together in."""
    codes = [np.unique(values, return_inverse=True)[1] for values in columns]
    # what is another number or text in every row tells no rows apart
    names = [of.dtype.kind != "f" or not (of % 1).any() for of in columns]
    n, telling = len(z), [code for code, name in zip(codes, names, strict=True) if code.max() + 1 < len(z) or not name]
    whole = np.column_stack([np.zeros(n), *telling])
    inputs, rows = (np.unique(row_uniforms(part), return_inverse=True)[1] for part in (whole, np.hstack((whole, z))))
    repeated, twins = (np.bincount(code)[code] > 1 for code in (inputs, rows))
    # in a table of few labels, rows repeat by chance
    continuous = 3 * whole.max() > inputs.max()
    if continuous and twins.mean() > 0.1:
        alike = f"{twins.sum()} of {n} rows are identical to another row, on both sides of the split"
        return [f"{alike}: coverage is that of repeated rows, not of new ones; drop the duplicates, or name units"]
    candidates = [(np.inf, "set of inputs", inputs)] if continuous and repeated.mean() > 0.1 else []
    dated = columns_where(X, is_time)
    for j, (code, values) in enumerate(zip(codes, columns, strict=True)):
        sizes = np.bincount(code)
        if not (3 * sizes.size <= n and 6 * sizes.max() < n) or j in dated:
            continue
        means = np.column_stack([np.bincount(code, part) for part in z.T]) / sizes[:, None]
        share = float((sizes @ means**2).max() / n)  # of the variance of the target
        # a number that means something has neighbours that are alike
        number = values.dtype.kind == "f" and ((np.diff(means, axis=0) ** 2).mean(axis=0) < means.var(axis=0)).any()
        if share > 0.1 and not number:
            candidates.append((share, _names(X)[j], code))
    for _, name, code in sorted(candidates, key=lambda one: -one[0])[:2]:
        order = np.random.default_rng(0).permutation(code.max() + 1)
        sizes = np.bincount(code)[order]
        drawn = np.isin(code, order[np.cumsum(sizes) <= max(_MOST_ROWS, sizes[0])])
        if np.unique(code[drawn]).size < 3:
            continue
        usual, new = (np.abs(_left_out(matrix[drawn], z[drawn], of[drawn])) for of in (np.arange(n), code))
        held = (new <= np.quantile(usual, 0.9, axis=0)).mean(axis=0).min()
        if held < _LEAST_HELD:
            told = f"rows of one {name} are alike: coverage is that of further rows of the same, not of a new {name}"
            return [f"{told}, of which sets for 90 % may hold {held:.0%}; name it as the unit (units=, --unit)"]
    return []


def _doubt_order(X: Any, columns: list[Any], matrix: FloatArray, z: FloatArray) -> list[str]:
    """Rows that are like their neighbours in the order of time, or of the index."""
    n, index = len(z), np.asarray(getattr(X, "index", np.arange(len(z))))
    dates = [columns[j] for j in columns_where(X, is_time)]
    usable = index.shape == (n,) and index.dtype.kind in "iufM" and np.unique(index).size == n
    order = np.argsort(dates[0] if dates else index if usable else np.arange(n), kind="stable")
    rows = order[:: -(-n // _MOST_ROWS)]
    matrix, z = matrix[rows], z[rows]
    if not dates:
        with np.errstate(invalid="ignore"):  # of a constant
            trend = np.corrcoef(np.arange(len(z)), rankdata(z, axis=0), rowvar=False)[0, 1:]
        if np.nanmax(np.abs(trend), initial=0) > 0.98:
            return []  # by the target, for show
    changing = matrix[:, (np.diff(matrix, axis=0) < 0).any(axis=0)]  # not what only counts the time, or the rows
    held = _held_later(matrix if dates else changing, z)
    matrix = changing if dates else matrix
    errors = _left_out(matrix, z, np.arange(len(z))) if matrix.shape[1] else z
    errors = errors - errors.mean(axis=0)
    alike = ((errors[1:] * errors[:-1]).mean(axis=0) / np.maximum((errors**2).mean(axis=0), 1e-300)).max()
    if alike < _ALIKE and held >= _LEAST_HELD_LATER:
        return []
    told = f"rows near each other in {'time' if dates else 'order'} are alike (correlation {alike:.2f})"
    if alike < _ALIKE:
        told = (
            f"the target depends on the {'date' if dates else 'order'}: sets for 90 % may hold {held:.0%} of later rows"
        )
    mend = "split in time (calibration='last', --split time)"
    return [f"{told}: coverage is that of rows in between, not of later rows; {mend}"]


def _held_later(matrix: FloatArray, z: FloatArray) -> float:
    """Share of the last fifth of rows that sets for 90 % from the rows before hold; 1 if chance explains it."""
    if not matrix.shape[1]:
        return 1.0
    later = np.arange(len(z)) >= len(z) - len(z) // 5
    reach = np.quantile(np.abs(_left_out(matrix, z, np.arange(len(z)))), 0.9, axis=0)
    n_held = (np.abs(_errors(matrix, z, ~later, later)) <= reach).sum(axis=0).min()
    return float(n_held / later.sum()) if bdtr(n_held, later.sum(), 0.9) < _CHANCE else 1.0


def _left_out(matrix: FloatArray, z: FloatArray, units: IntArray) -> FloatArray:
    """Errors (n, d) of a small forest that has not seen the unit of a row."""
    errors = np.empty_like(z)
    # not cross_val_predict, which takes no groups where the user has metadata routed
    for train, left_out in GroupKFold(3, shuffle=True, random_state=0).split(matrix, groups=units):
        errors[left_out] = _errors(matrix, z, train, left_out)
    return errors


def _errors(matrix: FloatArray, z: FloatArray, train: AnyArray, left_out: AnyArray) -> FloatArray:
    """Errors (m, d) of a small forest that has learnt from some rows."""
    target = z[train, 0] if z.shape[1] == 1 else z[train]
    forest = ExtraTreesRegressor(10, min_samples_leaf=2, random_state=0).fit(matrix[train], target)
    return np.asarray(z[left_out] - forest.predict(matrix[left_out]).reshape(-1, z.shape[1]))
