"""What ``reproduce table1`` shows: one table of the three comparisons first, then all of every split."""

from __future__ import annotations

from collections.abc import Sequence

from conformodal.core.words import counted
from conformodal.experiments.table1 import (
    METHODS,
    Record,
    Row,
    Table,
    TrainingTask,
    cost_table,
    lead_table,
    main_table,
    method_table,
    paper_region_table,
    region_table,
    size_table,
)
from conformodal.odometry import Method

from .comparison import Section, error_chart

_LEAD = "The published numbers, the paper's system here, and ours"
_LEAD_ALONE = "The published numbers, and the paper's system here"
_CAPTION = "Marks are means over seeds, whiskers reach from the best to the worst seed. Less is better."


def table1_sections(
    rows: Sequence[Row],
    tasks: Sequence[TrainingTask],
    results: Sequence[Record],
    records: Sequence[Record],
    splits: Sequence[str],
) -> list[Section]:
    """The first table, and a section a split.

    Parameters
    ----------
    rows, tasks, results, records
        Conditions, what was trained for them, and what came out; see :func:`~conformodal.experiments.table1.tidy`.
    splits
        In this order.
    """
    methods = {task.method for task in tasks}
    lead = _LEAD if Method.CONFORMODAL in methods else _LEAD_ALONE
    first = ("Position RMSE, and the regressors' over the system's", lead_table(rows, records, splits))
    sections = [Section(lead, "", "", [first])]
    for split in splits:
        tables: list[tuple[str, Table]] = []
        if Method.CONFORMODAL in methods:
            ours = main_table(rows, records, split), region_table(rows, records, split)
            names = (
                "Position and orientation RMSE of ours beside the published ones",
                "Our regions from softmax and landmarks, and from the softmax alone",
            )
            tables += zip(names, ours, strict=True)
        if Method.PAPER in methods:
            tables.append(("Regions of the paper's system", paper_region_table(rows, records, split)))
        tables += [
            ("Position RMSE of every method, in metres", method_table(rows, records, split)),
            (f"What they cost, at {rows[1].label}", cost_table(rows[1], records, split)),
        ]
        if Method.CONFORMODAL in methods:
            over_rows = size_table(rows, tasks, results, split)
            tables.append(("Rank correlation of our region's size over several rows together", over_rows))
        chart = error_chart([r.label for r in rows], _errors(rows, records, split), "m")
        sections.append(Section(f"Split {split}", _CAPTION, chart, tables))
    return sections


def table1_markdown(title: str, notes: Sequence[str], sections: Sequence[Section]) -> str:
    """The same without figures."""
    text = [f"# {title}"]
    for note in notes:
        text += ["", note]
    for section in sections:
        text += ["", f"## {section.heading}"]
        for name, table in section.tables:
            text += ["", f"{name}:", "", table.markdown()]
    return "\n".join(text) + "\n"


def _errors(rows: Sequence[Row], records: Sequence[Record], split: str) -> dict[str, list[list[float]]]:
    """Position RMSE by the label of every method that has records: for every row, of all seeds."""
    at = {(r["method"], r["row"], r["seed"]): r["rmse_m"] for r in records if r["split"] == split}
    seeds, there = sorted({seed for _, _, seed in at}), {method for method, _, _ in at}
    return {name: [[at[m, row.label, s] for s in seeds] for row in rows] for m, name in METHODS.items() if m in there}


def table1_notes(
    methods: Sequence[Method], seeds: Sequence[int], epochs: int, networks: str, workers: int
) -> list[str]:
    """How to read the tables.

    Parameters
    ----------
    methods
        Systems that were trained.
    seeds, epochs, networks, workers
        As they were asked for.
    """
    over = f"{counted(len(seeds), 'seed')} ({', '.join(map(str, seeds))})"
    passes = f"{counted(epochs, 'epoch')}"
    ours = Method.CONFORMODAL in methods
    notes = [
        f"Mean ± standard deviation over {over} of split and training, {passes}. Frozen features of "
        f"{networks.replace(',', ', ')}. The test frames, a fifth unless recordings or lists decide, are the same for "
        "every row; a fifth of the used frames calibrates. Noise is on the camera's pixels, in [0, 1], at test time "
        "only, for network and tracker alike. Ratio: the regressor's RMSE over the system's, seed by seed; above 1 the "
        "system is the better one."
    ]
    notes.append(
        "Published: the paper's table 1 (RGB-D Scenes; EfficientNet b0, b3 and b7). The paper's system here: sections "
        "2 and 3 of the paper as they stand, with its greedy answer; features of the whole network, averaged over the "
        "image. "
        + ("Ours: the smoothed answer; features are the network's map. " if ours else "")
        + "The regressors see the same features as the system that they stand beside, and are trained on the "
        "calibration frames too. Plain: the same epochs, optimiser and settings; nothing is searched. Tuned: learning "
        "rate, dropout and number of components (where there is one) are searched for each training, in batches of 32 "
        "where the system has 64. Regions are of single frames; each target at alpha = 0.1, so that set length (in "
        "standard deviations) and intervals are those of one target."
    )
    if ours:
        notes.append(
            "Of ours: other networks, where they were asked for (--baselines all), have learning rate and dropout "
            "searched, in batches of 32. Regions rest on "
            "softmax and landmarks. Whole pose covered: at alpha = 0.1 (joint max); promised for interleaved without "
            "noise, otherwise an observation. Size against error: rank correlation of the position region's size and "
            "the smoothed answer's error."
        )
    notes.append(
        f"Costs: wall time with --workers {workers} on this machine, searches for settings included"
        + (
            "; a projection of the features that several share counts with the first of them, mostly ours; the other "
            "networks but ours start from the tuned regressor's, whose search is counted once, as its own; locally "
            "linear regression is the part of our search that is one, alone"
            if ours
            else ""
        )
        + ". An answer is all that follows the features (and, for the systems, the motions)."
    )
    return notes
