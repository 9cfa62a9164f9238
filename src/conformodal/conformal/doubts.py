"""Doubts about rows: new ones unlike those learnt from, and ones whose coverage is not that of later rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np
from scipy.special import bdtr
from scipy.stats import betabinom, hypergeom, rankdata
from sklearn.ensemble import ExtraTreesRegressor
from sklearn.model_selection import GroupKFold
from sklearn.neighbors import NearestNeighbors

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray, IntArray
from conformodal.core.errors import ConformodalError
from conformodal.core.words import counted

from .density.encoder import columns_of, columns_where, dense_inputs, has_zone, is_frame, is_time, rows_of
from .density.named import most_correlated
from .scores import row_uniforms

Unlike = Literal["unbounded", "ignore"]

# told is what is no more likely than this in any column, if new rows are exchangeable with the training rows, and what
# lies ranges beyond a range; the share of a column, and the fewest values, that show how far its tails reach
_CHANCE, _FAR, _TAIL, _FEWEST_IN_TAIL = 3e-3, 10.0, 0.1, 20
# of a column's numbers at either end, beyond which new ones are counted
_OUTER = 0.01
# share of a column's spread by which it is moved, rows that show what follows, and by how much errors then grow
_MOVED, _FEWEST_TO_MOVE, _GROWN = 0.1, 40, 1.35
# rows of a forest that stands for the learner
_MAX_ROWS = 1000
# rounded targets are equal so many times as often between rows of the same inputs as between those of neighbouring ones
_CLOSER = 3.0
# rank correlation with the order from which on a table is sorted by a column; share of equal steps of a clock
_SORTED, _EVEN = 0.98, 0.95
# told are units and last rows of which sets for 90 % hold less, and orders in which errors of neighbours correlate more
_MIN_HELD, _MIN_HELD_LATER, _ALIKE = 0.72, 0.8, 0.6


class DataWarning(UserWarning):
    """Rows that are unlike each other in a way that coverage does not hold for, and what to do."""


def _chance(n_new: int, n_rows: int, rank: int, n_learnt: int) -> float:
    """Probability that so many of the new rows, or more, lie beyond the row of a `rank` among those learnt.

    Exact for exchangeable rows without ties, and an upper bound with ties: the number is beta-binomial.
    """
    usual = n_rows * rank / (n_learnt + 1)
    return float(betabinom.sf(n_new - 1, n_rows, rank, n_learnt + 1 - rank)) if n_new > usual else 1.0


def _chance_of_labels(learnt: dict[str, int], labels: AnyArray) -> float:
    """Probability that new rows have labels, none of which was learnt, that are as many or as frequent.

    Of labels with one row among all, the number of those learnt is hypergeometric if the rows are exchangeable. That a
    label of c rows has none among those learnt is so too, and their sum bounds the chance that any as frequent has
    none. Twice the smaller one, as there are two.
    """
    names, counts = np.unique(labels, return_counts=True)
    old = np.array([learnt.get(str(name), 0) for name in names])
    others = [count for name, count in learnt.items() if name not in set(names.tolist())]
    n, total = sum(learnt.values()), np.concatenate((counts + old, others))
    once, once_learnt = int((total == 1).sum()), others.count(1)
    few_learnt = float(hypergeom.cdf(once_learnt, n + len(labels), once, n))
    frequent = total[total >= counts[old == 0].max()]
    none_learnt = float(hypergeom.pmf(0, n + len(labels), frequent, n).sum())
    return min(1.0, 2 * min(few_learnt, none_learnt))


def _tail_index(values: FloatArray) -> float:
    """How fast extremes grow with the number of rows: as its power (Hill 1975), two standard errors above the estimate.

    Of the distances from the median; one, as of Pareto's 1 / x, where too few values differ from it.
    """
    away = np.sort(np.abs(values - np.median(values))) if values.size else values
    away = away[away > 0]
    if away.size < 2 * _FEWEST_IN_TAIL:
        return 1.0
    tail = away[-max(_FEWEST_IN_TAIL, int(_TAIL * away.size)) :]
    index = float(np.log(tail / tail[0]).mean())
    return index * float(1 + 2 / np.sqrt(tail.size))


@dataclass
class ColumnMemory:
    """What one column held: rows, rows without a value, range and tails of numbers, labels' counts, dates, a zone."""

    n: int = 0
    n_missing: int = 0
    low: float = np.inf
    high: float = -np.inf
    labels: dict[str, int] = field(default_factory=dict)
    dated: bool = False
    zone: bool = False
    tail: float = 0.0
    rank: int = 0  # of the numbers `inner_low` from below, and `inner_high` from above
    inner_low: float = np.inf
    inner_high: float = -np.inf

    def learn(self, values: Any) -> None:
        """Take in more rows of the column."""
        present = values[~_missing(values)]
        self.n, self.n_missing = self.n + len(values), self.n_missing + len(values) - len(present)
        if values.dtype.kind == "f":
            self.low, self.high = float(present.min(initial=self.low)), float(present.max(initial=self.high))
            self.tail = max(self.tail, _tail_index(present))
            if len(present):
                rank, ordered = max(1, int(_OUTER * len(present))), np.sort(present)
                self.rank += rank  # at most, of the lower one of two
                self.inner_low = min(self.inner_low, float(ordered[rank - 1]))
                self.inner_high = max(self.inner_high, float(ordered[-rank]))
        else:
            for label, count in zip(*np.unique(present, return_counts=True), strict=True):
                self.labels[str(label)] = self.labels.get(str(label), 0) + int(count)

    def compare(self, values: Any, name: object, least: float) -> tuple[BoolArray, list[str]]:
        """Whether each value is of a kind that never occurred, and what chance does not explain, in words.

        What occurred is told if its probability is below `least`, were the rows exchangeable.
        """
        gaps, words = _missing(values), list[str]()
        unlike, n_gaps, n_present = gaps & (self.n_missing == 0), int(gaps.sum()), self.n - self.n_missing
        if self.n_missing == self.n or (values.dtype.kind == "f" and self.labels):
            return unlike & False, words
        if unlike.any() or _chance(n_gaps, gaps.size, self.n_missing + 1, self.n) < least:
            words.append(f"{name} is missing in {n_gaps}, in training in {self.n_missing} of {self.n}")
        if values.dtype.kind == "f":
            outside = ~gaps & ((values < self.low) | (values > self.high))
            reach = max(_FAR, (gaps.size / (n_present * least)) ** self.tail) * (self.high - self.low)
            far = outside & (np.abs(values - (self.low + self.high) / 2) > reach)
            beyond, rank = ~gaps & ((values < self.inner_low) | (values > self.inner_high)), 2 * self.rank
            # later dates are what new rows have
            often = rank and not self.dated and _chance(int(beyond.sum()), gaps.size - n_gaps, rank, n_present) < least
            if far.any() or (often and outside.any()):
                ends = [np.datetime64(int(end), "D") if self.dated else f"{end:.6g}" for end in (self.low, self.high)]
                words.append(f"{name} is beyond {ends[0]} to {ends[1]}, its range, in {outside.sum()}")
            elif often:
                words.append(
                    f"{name} is beyond {self.inner_low:.6g} to {self.inner_high:.6g} in {beyond.sum()}, "
                    f"in training in at most {rank - 2} of {n_present}"
                )
            return unlike, words
        new = ~gaps & ~np.isin(values, list(self.labels))
        # where all labels repeat, there are no others (Good 1953)
        never = new & (1 not in self.labels.values())
        if never.any() or (new.any() and _chance_of_labels(self.labels, values[~gaps]) < least):
            label = str(values[new][0])
            same = [old for old in self.labels if old.strip().casefold() == label.strip().casefold()]
            hint = f", which may be {same[0]!r}" if same else ""
            words.append(f"{name} has a label that is new in {new.sum()}, such as {label!r}{hint}")
        return unlike | never, words


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
        least = _CHANCE / max(len(self.columns), 1)
        for j, (memory, values) in enumerate(zip(self.columns, _columns(X, texts), strict=False)):
            rows, told = memory.compare(values, names[j], least)
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


def doubt_seen(medians: Callable[[Any], FloatArray], X: Any, y: FloatArray) -> str:
    """Why a model seems to have learnt from these rows, or nothing; `medians` predicts (n, d), `y` are (n, d).

    A model is close to values that it has learnt from only at their own inputs: its errors grow as numbers move by a
    tenth of their spread to either side. What it has not seen is as far from it there as at the inputs themselves.
    """
    rows = np.random.default_rng(0).permutation(len(y))[:_MAX_ROWS]
    X, y = rows_of(X, rows), y[rows]
    dated = columns_where(X, is_time)
    numbers = [
        j
        for j, column in enumerate(_columns(X))
        if column.dtype.kind == "f" and j not in dated and np.unique(column).size > _FEWEST_TO_MOVE  # else a grid
    ]
    if len(y) < _FEWEST_TO_MOVE or not numbers:
        return ""
    there, moved = medians(X), [medians(_moved(X, numbers, sign)) for sign in (1, -1)]
    errors, pulls = y - there, there - (moved[0] + moved[1]) / 2
    at, around = np.abs(errors).mean(axis=0), np.abs(errors + pulls).mean(axis=0)
    j = int(np.argmax(around - _GROWN * at))
    if around[j] <= _GROWN * at[j]:
        return ""
    grown = f"from {at[j]:.3g} to {around[j]:.3g}"
    return (
        f"its errors on {counted(len(y), 'calibration sample')} grow {grown} where inputs move by a tenth of their "
        "spread, so it seems to have learnt from these samples: sets are too small. Give samples that it has not seen"
    )


def _moved(X: Any, numbers: list[int], sign: int) -> Any:
    """The rows with some numbers moved at random, by a tenth of their standard deviations, to one side or the other."""
    random, moved = np.random.default_rng(1), X.copy()
    for j in numbers:
        values = _columns(X)[j]
        steps = sign * _MOVED * np.nan_to_num(np.nanstd(values)) * random.normal(size=len(values))
        if hasattr(moved, "iloc"):
            moved.isetitem(j, values + steps)
        else:
            moved[:, j] = values + steps
    return moved


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
    if continuous and twins.mean() > 0.1 + _twins_by_rounding(inputs, matrix, z):
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
        drawn = np.isin(code, order[np.cumsum(sizes) <= max(_MAX_ROWS, sizes[0])])
        if np.unique(code[drawn]).size < 3:
            continue
        usual, new = (np.abs(_left_out(matrix[drawn], z[drawn], of[drawn])) for of in (np.arange(n), code))
        held = (new <= np.quantile(usual, 0.9, axis=0)).mean(axis=0).min()
        if held < _MIN_HELD:
            told = f"rows of one {name} are alike: coverage is that of further rows of the same, not of a new {name}"
            return [f"{told}, of which sets for 90 % may hold {held:.0%}; name it as the unit (units=, --unit)"]
    return []


def _twins_by_rounding(inputs: IntArray, matrix: FloatArray, z: FloatArray) -> float:
    """Share of rows that another row would equal by chance, as values are rounded.

    Rounded targets are equal about as often between rows of the same inputs as between those and their nearest other
    inputs; targets of copies never are. `inputs` (n,) number the distinct ones.
    """
    _, first, sizes = np.unique(inputs, return_index=True, return_counts=True)
    if first.size < 2:
        return 0.0
    spread = matrix.std(axis=0)
    scaled = matrix[first] / np.where(spread > 0, spread, 1.0)
    asked = np.random.default_rng(0).permutation(first.size)[:_MAX_ROWS]
    nearest = NearestNeighbors(n_neighbors=2).fit(scaled).kneighbors(scaled[asked], return_distance=False)
    rows = np.split(np.argsort(inputs, kind="stable"), np.cumsum(sizes)[:-1])
    targets = np.unique(z, axis=0, return_inverse=True)[1].ravel()
    equal = np.empty(asked.size)
    for k, (own, pair) in enumerate(zip(asked, nearest, strict=True)):
        other = int(pair[0] if pair[0] != own else pair[1])
        equal[k] = (targets[rows[own]][:, None] == targets[rows[other]]).mean()
    chance = min(1.0, _CLOSER * float(np.average(equal, weights=sizes[asked])))
    return float(np.average(1 - (1 - chance) ** (sizes - 1), weights=sizes))


def _doubt_order(X: Any, columns: list[Any], matrix: FloatArray, z: FloatArray) -> list[str]:
    """Rows that are like their neighbours in the order of time, or of the index."""
    n, index = len(z), np.asarray(getattr(X, "index", np.arange(len(z))))
    dates = [columns[j] for j in columns_where(X, is_time)]
    usable = index.shape == (n,) and index.dtype.kind in "iufM" and np.unique(index).size == n
    order = np.argsort(dates[0] if dates else index if usable else np.arange(n), kind="stable")
    if not dates and _sorted_by_an_input([*columns, *([index] if index.dtype.kind == "f" and usable else [])], order):
        return []
    rows = order[:: -(-n // _MAX_ROWS)]
    matrix, z = matrix[rows], z[rows]
    if not dates and np.abs(_trends(z)).max(initial=0) > _SORTED:
        return []  # by the target, for show
    clocks = np.array([_is_even(column) for column in matrix.T], dtype=np.bool_)
    changing = (np.diff(matrix, axis=0) < 0).any(axis=0) & ~clocks  # not what only counts the time, or the rows
    held = _held_later(matrix if dates else matrix[:, changing], z)
    matrix = matrix if clocks.all() and not dates else matrix[:, changing if dates else ~clocks]  # a grid alone
    errors = _left_out(matrix, z, np.arange(len(z))) if matrix.shape[1] else z
    errors = errors - errors.mean(axis=0)
    alike = ((errors[1:] * errors[:-1]).mean(axis=0) / np.maximum((errors**2).mean(axis=0), 1e-300)).max()
    if alike < _ALIKE and held >= _MIN_HELD_LATER:
        return []
    told = f"rows near each other in {'time' if dates else 'order'} are alike (correlation {alike:.2f})"
    if alike < _ALIKE:
        told = (
            f"the target depends on the {'date' if dates else 'order'}: sets for 90 % may hold {held:.0%} of later rows"
        )
    mend = "split in time (calibration='last', --split time)"
    return [f"{told}: coverage is that of rows in between, not of later rows; {mend}"]


def _trends(values: FloatArray) -> FloatArray:
    """Rank correlations (d,) of columns (n, d) with their order; 0 of constants."""
    with np.errstate(invalid="ignore"):
        trends = np.corrcoef(np.arange(len(values)), rankdata(values, axis=0), rowvar=False)[0, 1:]
    return np.nan_to_num(trends)


def _sorted_by_an_input(columns: list[AnyArray], order: IntArray) -> bool:
    """Whether the order is that of a column, of numbers or labels, that does not count rows or time in even steps."""
    for values in columns:
        ranks = np.unique(values[order], return_inverse=True)[1].astype(np.float64)
        if not np.abs(_trends(ranks[:, None]))[0] > _SORTED:
            continue
        if values.dtype.kind not in "fiu":
            return True
        if not _is_even(values[order].astype(np.float64)):
            return True
    return False


def _is_even(values: FloatArray) -> bool:
    """Whether numbers (n,) go up or down in even steps, as those of a clock or a count of rows."""
    steps = np.diff(values)
    usual = float(np.median(steps))
    return bool(usual) and bool((np.abs(steps - usual) <= 1e-6 * abs(usual)).mean() > _EVEN)


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
