"""The tables and the picture of the ladder, from the numbers of all places and seeds."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
from common import ROOT, half_width, mean_interval, write_page

mpl.use("Agg")
from matplotlib import pyplot as plt

Numbers = dict[tuple[str, int], dict[str, Any]]
INTERVALS = ("1/6 s", "1 s", "3 s", "all")
SMALL = 0.03  # a part that changes an error by less is worth nothing there
SOURCE = ROOT / "src" / "conformodal"
# Files that are there for a part alone.
FILES = {
    "neighbours": ["localization/neighbours/*.py"],
    "landmarks": ["localization/landmarks/*.py", "localization/local_features.py"],
    "submaps": ["motion/submaps.py", "motion/bundle.py", "poses/submap.py", "reasoning/submap_alignment.py"],
    "relative rotations": ["motion/relative_pose.py", "motion/two_view.py", "motion/tracker.py", "motion/frontend.py"],
    "limits on speed and turning": ["reasoning/prior.py"],
    "Viterbi (each frame's most probable candidate)": ["reasoning/viterbi.py"],
    "bridging of unknown frames": ["reasoning/bridging.py"],
    "smoother": ["reasoning/smoother.py", "reasoning/orientations.py"],
    "projection": ["vision/projection.py"],
}
# Stages of training, and times of a frame, that are there for a part alone.
STAGES = {"neighbours": ("neighbours",), "landmarks": ("local features", "landmarks")}
TIMES = {
    "neighbours": ("neighbours",),
    "landmarks": ("local features", "landmarks"),
    "Viterbi (each frame's most probable candidate)": ("Viterbi",),
    "smoother": ("smoother",),
}


def conditions(numbers: Numbers) -> list[tuple[str, str]]:
    """Places and intervals that were measured, in order."""
    places = list(dict.fromkeys(place for place, _ in numbers))
    return [(p, i) for p in places for i in INTERVALS if any(i in one for (q, _), one in numbers.items() if q == p)]


def of_seeds(numbers: Numbers, at: tuple[str, str], pick: Callable[[dict[str, Any]], Any]) -> list[Any]:
    """What all seeds of a condition say; those that say nothing are left out."""
    found = (pick(one[at[1]]) for (place, _), one in numbers.items() if place == at[0] and at[1] in one)
    return [value for value in found if value is not None]


def ratio_of(values: list[float]) -> tuple[float, float, float] | None:
    """Geometric mean of ratios and its 95 % interval."""
    if not values:
        return None
    logs = np.log(values)
    mean, half = logs.mean(), half_width(logs.tolist())
    return tuple(float(np.exp(v)) for v in (mean, mean - half, mean + half))  # type: ignore[return-value]


def ratio_cell(values: list[float]) -> str:
    found = ratio_of(values)
    if found is None:
        return ""
    mean, low, high = found
    return f"{mean:.2f}" if np.isnan(low) else f"{mean:.2f} ({low:.2f} to {high:.2f})"


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (header, ["---"] * len(header), *rows)]


def names_of(numbers: Numbers, key: str) -> list[str]:
    found: dict[str, None] = {}
    for one in numbers.values():
        for interval in INTERVALS:
            found |= dict.fromkeys(one.get(interval, {}).get(key, {}))
    return list(found)


def removed_ratios(numbers: Numbers, part: str, at: tuple[str, str], unit: int = 0) -> list[float]:
    pick = lambda one: one["removed"][part][unit] / one["ours"][unit] if part in one["removed"] else None  # noqa: E731
    return of_seeds(numbers, at, pick)


def worthless(numbers: Numbers, *, surely: bool) -> list[tuple[str, float, float]]:
    """Parts whose removal raises no error, of position or orientation, by more than a few per cent; least and most.

    With `surely` a part is left out only for an error whose whole interval is higher by more than that.
    """
    found = []
    for part in names_of(numbers, "removed"):
        ratios = [
            ratio
            for at in conditions(numbers)
            for unit in (0, 1)
            if (ratio := ratio_of(removed_ratios(numbers, part, at, unit)))
        ]
        worst = max((low if surely and not np.isnan(low) else mean for mean, low, _ in ratios), default=np.inf)
        if worst <= 1 + SMALL:
            found.append((part, min(r[0] for r in ratios), max(r[0] for r in ratios)))
    return found


def lines_of(part: str) -> str:
    files = [file for pattern in FILES.get(part, []) for file in SOURCE.glob(pattern)]
    return str(sum(len(f.read_text(encoding="utf-8").splitlines()) for f in files)) if files else ""


def costs(numbers: Numbers, place: str) -> dict[str, tuple[str, str]]:
    """Seconds of training and milliseconds a frame that a part costs at a place: medians over seeds."""
    here = [one for (p, _), one in numbers.items() if p == place]
    found = {}
    for part in names_of(numbers, "removed"):
        seconds = [sum(one["train_s"].get(s, 0.0) for s in STAGES.get(part, ())) for one in here]
        ms = [sum(one["ms"].get(t, 0.0) for t in TIMES.get(part, ())) for one in here]
        found[part] = tuple(f"{np.median(v):.{d}f}" if v and max(v) else "" for v, d in ((seconds, 0), (ms, 1)))
    return found  # type: ignore[return-value]


def draw(numbers: Numbers) -> None:
    """Errors along the steps, a line a condition."""
    mpl.rcParams.update({"svg.hashsalt": "ladder", "svg.fonttype": "none", "font.size": 9})
    names = names_of(numbers, "steps")
    figure, axis = plt.subplots(figsize=(10, 5), layout="constrained")
    places = list(dict.fromkeys(place for place, _ in conditions(numbers)))
    styles = dict(zip(INTERVALS, ("-", "--", ":", "-."), strict=True))
    for place, interval in conditions(numbers):
        at, means = [], []
        for k, name in enumerate(names):
            values = of_seeds(numbers, (place, interval), lambda one, n=name: one["steps"].get(n))
            if values:
                at.append(k)
                means.append(float(np.exp(np.mean(np.log([v[0] for v in values])))))
        axis.plot(
            at, means, styles[interval], marker=".", color=f"C{places.index(place)}", label=f"{place}, {interval}"
        )
    axis.set(yscale="log", ylabel="RMSE of positions (m)", xticks=range(len(names)))
    axis.set_xticklabels(names, rotation=35, ha="right", fontsize=8)
    axis.grid(axis="y", alpha=0.3)
    axis.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False, fontsize=7)
    figure.savefig(ROOT / "docs" / "images" / "ladder.svg", metadata={"Date": None})


def write_tables(numbers: Numbers) -> None:
    """``benchmarks/results/ladder.md`` and ``docs/images/ladder.svg``."""
    if not numbers:
        return
    wanted = conditions(numbers)
    header = [f"{place}, {interval}" for place, interval in wanted]
    steps = [
        [
            name,
            *(
                mean_interval([v[0] for v in of_seeds(numbers, at, lambda one, n=name: one["steps"].get(n))])
                for at in wanted
            ),
        ]
        for name in names_of(numbers, "steps")
    ]
    cost = costs(numbers, "redkitchen, interleaved")
    parts = sorted(names_of(numbers, "removed"))
    removed = [
        [part, *(ratio_cell(removed_ratios(numbers, part, at)) for at in wanted), lines_of(part), *cost[part]]
        for part in parts
    ]
    turned = [[part, *(ratio_cell(removed_ratios(numbers, part, at, 1)) for at in wanted)] for part in parts]
    switches = [
        [
            name,
            *(
                mean_interval([v[0] for v in of_seeds(numbers, at, lambda one, n=name: one["switches"].get(n))])
                for at in wanted
            ),
        ]
        for name in names_of(numbers, "switches")
    ]
    frames = [", ".join(map(str, sorted(set(of_seeds(numbers, at, lambda one: one["frames"]))))) for at in wanted]
    content = [
        "Position RMSE in metres, mean over seeds and 95 % interval (Student's t). Each row has one change more than "
        "the row above it.",
        "",
        *table(["system", *header], [["test frames", *frames], *steps]),
        "",
        "## Ours with one part left out",
        "",
        "Position error without the part over the error with it: geometric mean over seeds and 95 % interval. Lines: "
        "of files that are there for the part alone. Seconds of training and milliseconds a frame: on redkitchen, "
        "`interleaved`, one core, medians over seeds.",
        "",
        *table(["left out", *header, "lines", "s of training", "ms a frame"], removed),
        "",
        "The same of orientation errors:",
        "",
        *table(["left out", *header], turned),
        "",
        f"Parts whose removal raises no error of position or orientation by more than {100 * SMALL:.0f} %, and the "
        "least and the largest ratio over all columns:",
        "",
        *[f"- {part}: {low:.2f} to {high:.2f}" for part, low, high in worthless(numbers, surely=False)],
        "",
        "Parts for which no column's whole interval lies above that (with few seeds intervals are wide, so that such a "
        "part may still be worth something):",
        "",
        *[f"- {part}: {low:.2f} to {high:.2f}" for part, low, high in worthless(numbers, surely=True)],
        "",
        "## Limits and relative rotations",
        "",
        "Position RMSE of the smoothed path, metres. Limits are those on speed and turning.",
        "",
        *table(["evidence, limits, relative rotations", *header], switches),
        "",
        "## Regions",
        "",
        "Whole pose covered (promised: 0.9 on `interleaved`, nothing on `blocks`), and mean length of the position's "
        "sets in standard deviations; frames that show a known place; means over seeds.",
        "",
        *_regions(numbers),
        "",
        _note(numbers),
    ]
    write_page("ladder", "From the paper's system to ours", shlex.join(["python", *sys.argv]), content)
    draw(numbers)


def _regions(numbers: Numbers) -> list[str]:
    places = list(dict.fromkeys(place for place, _ in numbers))
    names: dict[str, None] = {}
    for one in numbers.values():
        names |= dict.fromkeys(one["regions"])
    labels = {"all": "all sources", "overall": "without local features", "lac": "softmax alone, score `lac`"}
    rows = []
    for name in names:
        for kind, label in labels.items():
            cells = []
            for place in places:
                found = [
                    one["regions"][name][kind]
                    for (p, _), one in numbers.items()
                    if p == place and name in one["regions"]
                ]
                finite = [f for f in found if np.isfinite(f[1])]
                covered = f"{np.mean([f[0] for f in found]):.3f}" if found else ""
                cells.append(f"{covered}, {np.mean([f[1] for f in finite]):.3f}" if finite else covered)
            if kind != "lac" or name == "ours":
                rows.append([name if name == "ours" else f"ours without {name}", label, *cells])
    return table(["model", "region from", *places], rows)


def _note(numbers: Numbers) -> str:
    seeds = sorted({seed for _, seed in numbers})
    sources = sorted({one["source"] for one in numbers.values()})
    quick = sorted(f"{place} {seed}" for (place, seed), one in numbers.items() if one.get("quick"))
    only = f" Rows that need other models than ours lack {', '.join(quick)}." if quick else ""
    return (
        f"Seeds {', '.join(map(str, seeds))} of split, training and corridor; no value of a "
        f"setting was chosen on them. Measured with source {', '.join(sources)}. "
        "Test frames, a fifth of all: all of them (1/6 s, all), "
        "or those that follow each other after 1 s or 3 s. The tracker always sees the frames between. Frames "
        "calibrate in both splits. "
        "Errors on redkitchen are against KinectFusion's poses, which differ by 4.9 cm from the other published "
        "reference (two_truths.md): differences of millimetres say how two systems agree with one reference. TUM "
        "cabinet (58 frames) and KITTI 06 (51) have 12 test frames or fewer." + only
    )
