"""How often tables are called unlike, copied or drifting: where rows are exchangeable, and where they are not.

python benchmarks/table_warnings.py
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from common import parser_of, write_table

from conformodal.conformal.doubts import TableMemory, doubt_rows

SEEDS, N = range(100, 200), 400
SIZES = ((500, 500), (500, 20_000))
Random = np.random.Generator
Column = Callable[[Random, int], Any]

COLUMNS: dict[str, Column] = {
    "normal": lambda rng, n: rng.normal(size=n),
    "5 % missing": lambda rng, n: np.where(rng.random(n) < 0.05, np.nan, rng.random(n)),
    "Pareto, index 1": lambda rng, n: 1 / rng.random(n),
    "Zipf labels, exponent 1.5": lambda rng, n: rng.zipf(1.5, n).astype(str),
    "geometric labels, rate 0.02": lambda rng, n: rng.geometric(0.02, n).astype(str),
}
# the same columns, of which new rows are changed
SHIFTS: dict[str, tuple[str, Column]] = {
    "normal, mean + 1": ("normal", lambda rng, n: rng.normal(1, 1, n)),
    "normal, deviation * 1.5": ("normal", lambda rng, n: rng.normal(0, 1.5, n)),
    "normal, one value of 9999": ("normal", lambda rng, n: np.append(rng.normal(size=n - 1), 9999)),
    "10 % missing for 5 %": ("5 % missing", lambda rng, n: np.where(rng.random(n) < 0.1, np.nan, rng.random(n))),
    "Pareto, another unit (1000)": ("Pareto, index 1", lambda rng, n: 1000 / rng.random(n)),
    "Zipf, one new label in 2 %": (
        "Zipf labels, exponent 1.5",
        lambda rng, n: np.where(rng.random(n) < 0.02, "X", rng.zipf(1.5, n).astype(str)),
    ),
    "Zipf, labels of their own in 10 %": (
        "Zipf labels, exponent 1.5",
        lambda rng, n: np.where(rng.random(n) < 0.1, np.arange(n).astype("U9"), rng.zipf(1.5, n).astype(str)),
    ),
}


def usual(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
    X = pd.DataFrame(rng.normal(size=(N, 4)), columns=list("abcd"))
    return X, (X.a + np.sin(2 * X.b) + 0.7 * rng.normal(size=N)).to_numpy()


def sorted_by_input(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
    X, y = usual(rng)
    order = np.argsort(X.a.to_numpy())
    return X.iloc[order].reset_index(drop=True), y[order]


def sorted_by_hidden(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
    X, y = usual(rng)
    hidden = np.sort(rng.normal(size=N))
    return X, y + hidden


def rounded(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
    x = rng.uniform(0, 3, N).round(1)
    return pd.DataFrame({"x": x}), (x + rng.normal(0, 0.3, N)).round(1)


def labelled(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
    X, y = usual(rng)
    label = rng.integers(0, 20, N)
    return X.assign(city=label.astype(str)), y + np.random.default_rng(1).normal(0, 1.5, 20)[label]


def dated(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
    X, y = usual(rng)
    return X.assign(date=pd.Timestamp("2020-01-01") + pd.to_timedelta(rng.uniform(0, 1000, N), "D")), y


def drift(size: float, with_dates: bool = False) -> Any:
    def draw(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
        X, y = usual(rng)
        days = np.sort(rng.uniform(0, 1000, N))
        X = X.assign(date=pd.Timestamp("2020-01-01") + pd.to_timedelta(days, "D")) if with_dates else X
        return X, y + size * np.arange(N) / N

    return draw


def autoregressive(rho: float) -> Any:
    def draw(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
        X, y = usual(rng)
        error = np.zeros(N)
        for i in range(1, N):
            error[i] = rho * error[i - 1] + np.sqrt(1 - rho**2) * rng.normal()
        return X, y + 1.5 * error

    return draw


def subjects(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
    X, y = usual(rng)
    of = rng.permutation(np.arange(N) % 20)
    return X.assign(subject=of.astype(str)), y + rng.normal(0, 2, 20)[of]


def copies(noise: float) -> Any:
    def draw(rng: Random) -> tuple[pd.DataFrame, np.ndarray]:
        X, y = usual(rng)
        again = rng.permutation(N)[: N // 3]
        X = pd.concat([X, X.iloc[again] + noise * rng.normal(size=(len(again), 4))], ignore_index=True)
        y = np.concatenate((y, y[again] + noise * rng.normal(size=len(again))))
        order = rng.permutation(len(y))
        return X.iloc[order].reset_index(drop=True), y[order]

    return draw


TABLES: dict[str, tuple[bool, Any]] = {
    "no order": (True, usual),
    "sorted by an input": (True, sorted_by_input),
    "rounded to 0.1": (True, rounded),
    "20 labels with effects": (True, labelled),
    "dates drawn at random": (True, dated),
    "sorted by a column that is left out": (True, sorted_by_hidden),
    "drift by 2 standard deviations": (False, drift(2.4)),
    "drift by 4": (False, drift(5.0)),
    "drift by 2, beside a date": (False, drift(2.4, with_dates=True)),
    "drift by 4, beside a date": (False, drift(5.0, with_dates=True)),
    "errors AR(0.8)": (False, autoregressive(0.8)),
    "errors AR(0.95)": (False, autoregressive(0.95)),
    "20 subjects, deviation 2": (False, subjects),
    "a third copied": (False, copies(0.0)),
    "a third copied with noise of 0.001": (False, copies(1e-3)),
}


def told_at_predict(learnt: Column, new: Column, sizes: tuple[int, int]) -> int:
    told = 0
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        old, later = (pd.DataFrame({"v": draw(rng, n)}) for draw, n in zip((learnt, new), sizes, strict=True))
        told += bool(TableMemory().learn(old).compare(later)[1])
    return told


def told_at_fit(draw: Any) -> int:
    tables = (draw(np.random.default_rng(seed)) for seed in SEEDS)
    return sum(bool(doubt_rows(X, np.asarray(y)[:, None], False, False)) for X, y in tables)


def main() -> None:
    parser_of(__doc__).parse_args()
    warnings.simplefilter("ignore")
    pairs = [(name, "yes", draw, draw) for name, draw in COLUMNS.items()]
    pairs += [(name, "no", COLUMNS[base], draw) for name, (base, draw) in SHIFTS.items()]
    rows = []
    for name, exchangeable, old, new in pairs:
        for sizes in SIZES:
            where = f"predict: {sizes[0]} learnt, {sizes[1]:,} new"
            rows.append([where, name, exchangeable, str(told_at_predict(old, new, sizes))])
            print(*rows[-1], flush=True)
    for name, (exchangeable, draw) in TABLES.items():
        rows.append([f"fit: {N} rows", name, "yes" if exchangeable else "no", str(told_at_fit(draw))])
        print(*rows[-1], flush=True)
    notes = (
        f"Tables with a warning, of {len(SEEDS)}. Exchangeable: yes, a warning is false; no, it is right. "
        "For `predict`, one column; for `fit`, four normal inputs, and errors of the target with deviation 0.7."
    )
    header = ["when", "rows", "exchangeable", "warned"]
    write_table("table_warnings", "Warnings about tables", "python benchmarks/table_warnings.py", header, rows, notes)


if __name__ == "__main__":
    main()
