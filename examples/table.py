"""Regions of rows of a table: of a CSV file with numbers in named columns, or of an arm whose elbow is up or down.

python examples/table.py [FILE.csv TARGET...]
"""

import sys

import numpy as np

import conformodal as cm

FEWEST = 50  # a fifth is tested, and a fifth of the rest calibrates


def read_table(file: str, targets: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs, targets, and numbers of their rows; columns of text and rows with a missing value are left out."""
    table = np.genfromtxt(file, delimiter=",", names=True, deletechars="", replace_space=" ", encoding="utf-8-sig")
    numbers = [name for name in table.dtype.names if np.isfinite(np.atleast_1d(table[name])).mean() > 0.5]
    inputs = [name for name in numbers if name not in targets]
    if not targets or not inputs or not set(targets) <= set(numbers):
        sys.exit(f"{file}: name targets among its columns of numbers, {', '.join(numbers)}; got {', '.join(targets)}")
    X, y = (np.column_stack([table[name] for name in names]) for names in (inputs, targets))
    whole = np.isfinite(X).all(axis=1) & np.isfinite(y).all(axis=1)
    print(f"inputs: {', '.join(inputs)}; {np.sum(~whole)} of {len(whole)} rows left out, which miss a value")
    if whole.sum() < FEWEST:
        sys.exit(f"{file}: {whole.sum()} whole rows are too few; at least {FEWEST} are needed")
    return X[whole], y[whole], np.flatnonzero(whole) + 1


def two_link_arm(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reach in metres; angle of the elbow in degrees, which is up in half of the rows, and height of the hand."""
    rng = np.random.default_rng(0)
    reach = rng.uniform(0.4, 1.9, n)
    elbow = rng.choice([-1, 1], n) * np.degrees(np.arccos(reach**2 / 2 - 1)) + rng.normal(0, 4, n)
    return reach[:, None], np.column_stack([elbow, 1.2 - 0.3 * reach + rng.normal(0, 0.02, n)]), np.arange(n) + 1


if __name__ == "__main__":
    names = sys.argv[2:] if sys.argv[1:] else ["elbow", "height"]
    X, y, number = read_table(sys.argv[1], names) if sys.argv[1:] else two_link_arm(3000)
    order = np.random.default_rng(0).permutation(len(X))
    test, train = np.split(order, [len(X) // 5])

    # "max": the region holds all targets of a row together with probability 0.9; a fifth of `train` calibrates
    reg = cm.ConformalRegressor(alpha=0.1, joint="max", random_state=0).fit(X[train], y[train])
    regions = reg.predict_region(X[test])

    several = (regions.n_intervals > 1).any(axis=1)
    for row in sorted({0, 1, *np.flatnonzero(several)[:1]}):
        for name, parts, true in zip(names, regions.intervals(row), y[test[row]], strict=True):
            ranges = " or ".join(f"{low:.4g} to {high:.4g}" for low, high in parts)
            print(f"row {number[test[row]]} of the table, {name}: {ranges} (true: {true:.4g})")
    print(f"several intervals: {several.mean():.2f} of the rows")
    print(reg.diagnose(X[test], y[test], names=names))  # coverage beside the band that chance alone explains
