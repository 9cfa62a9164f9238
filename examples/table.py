"""Regions of rows of a table: of a CSV file with numbers in named columns, or of an arm whose elbow is up or down.

python examples/table.py [FILE.csv TARGET...]
"""

import sys

import numpy as np

import conformodal as cm


def read_table(file: str, targets: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs, targets, and the file's line of each row; columns of text and rows with a missing value are left out."""
    table = np.genfromtxt(file, delimiter=",", names=True, deletechars="", replace_space=" ", encoding="utf-8")
    unknown = [name for name in targets if name not in table.dtype.names]
    if unknown or not targets:
        sys.exit(f"{file}: name targets among its columns, {', '.join(table.dtype.names)}; got {', '.join(targets)}")
    inputs = [name for name in table.dtype.names if name not in targets and np.isfinite(table[name]).any()]
    X, y = (np.column_stack([table[name] for name in names]) for names in (inputs, targets))
    whole = np.isfinite(X).all(axis=1) & np.isfinite(y).all(axis=1)
    return X[whole], y[whole], np.flatnonzero(whole) + 2  # the first line holds the names


def two_link_arm(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reach in metres; angle of the elbow in degrees, which is up in half of the rows, and height of the hand."""
    rng = np.random.default_rng(0)
    reach = rng.uniform(0.4, 1.9, n)
    elbow = rng.choice([-1, 1], n) * np.degrees(np.arccos(reach**2 / 2 - 1)) + rng.normal(0, 4, n)
    return reach[:, None], np.column_stack([elbow, 1.2 - 0.3 * reach + rng.normal(0, 0.02, n)]), np.arange(n)


if __name__ == "__main__":
    names = sys.argv[2:] if sys.argv[1:] else ["elbow", "height"]
    where = "line" if sys.argv[1:] else "row"
    X, y, line = read_table(sys.argv[1], names) if sys.argv[1:] else two_link_arm(3000)
    order = np.random.default_rng(0).permutation(len(X))
    test, train = np.split(order, [len(X) // 5])

    # "max": the region holds all targets of a row together with probability 0.9; a fifth of `train` calibrates
    reg = cm.ConformalRegressor(alpha=0.1, joint="max", random_state=0).fit(X[train], y[train])
    regions = reg.predict_region(X[test])

    several = (regions.n_intervals > 1).any(axis=1)
    for row in sorted({0, 1, *np.flatnonzero(several)[:1]}):
        for name, parts, true in zip(names, regions.intervals(row), y[test[row]], strict=True):
            ranges = " or ".join(f"{low:.4g} to {high:.4g}" for low, high in parts)
            print(f"{where} {line[test[row]]}, {name}: {ranges} (true: {true:.4g})")
    print(f"several intervals: {several.mean():.2f} of the rows")
    print(reg.diagnose(X[test], y[test], names=names))  # coverage beside the band that chance alone explains
