"""What a revision answers in four worlds, and how it differs from what another one answered.

Run it before and after a change that should leave behaviour as it is::

    python benchmarks/behaviour.py answer OUT                   # trains and runs: some ten minutes
    python benchmarks/behaviour.py answer OLD --source OLD_SRC  # the same with another revision's src folder
    python benchmarks/behaviour.py compare OLD OUT
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from common import DATA, REDKITCHEN, ROOT, parser_of, table_lines

DESK, XYZ = DATA / "tum" / "fr1_desk", DATA / "tum" / "fr1_xyz"
DEMO = ("--split", "interleaved", "--epochs", "40", "--dropout", "0.6", "--alpha", "0.02")
SOURCES = "head,landmarks"
ROUNDING = 1e-9
_FLY = """
import sys
from pathlib import Path
try:
    from conformodal.corridor import write_corridor
except ImportError:
    from conformodal.datasets.corridor import write_corridor
write_corridor(Path(sys.argv[1]), n_modules=5, n_laps=2, seed=0)
"""


def worlds(corridor: Path) -> dict[str, tuple[Path, tuple[str, ...], Path, tuple[str, ...]]]:
    """Recording to train on, options of ``train``, source to run on, options of ``run``."""
    test = ("--part", "test")
    return {
        "corridor": (corridor, DEMO, corridor, test),
        "redkitchen_interleaved": (REDKITCHEN, ("--split", "interleaved"), REDKITCHEN, test),
        "redkitchen_blocks": (REDKITCHEN, ("--split", "blocks"), REDKITCHEN, test),
        "fr1_xyz_from_desk": (DESK, ("--split", "blocks"), XYZ, ()),
    }


def answer(out: Path, source: Path, sources: str, seed: int, names: list[str]) -> None:
    """Train and run in each world with the package in a source folder."""
    python = [sys.executable, "-c"]
    environment = {**os.environ, "PYTHONPATH": str(source), "CONFORMODAL_CACHE": str(out / "cache")}

    def call(*arguments: object) -> None:
        with (out / "log.txt").open("a", encoding="utf-8") as log:
            subprocess.run([str(a) for a in arguments], check=True, env=environment, stdout=log, stderr=log)

    out.mkdir(parents=True, exist_ok=True)
    corridor = out / "corridor-data"
    if not corridor.exists():
        call(*python, _FLY, corridor)
    command = [*python, "from conformodal.cli import main; main()"]
    for name, (recording, how, queries, part) in worlds(corridor).items():
        if name in names:
            model = out / name / "model"
            call(*command, "train", recording, "--out", model, "--seed", seed, "--sources", sources, *how)
            call(*command, "run", model, queries, "--out", out / name / "run", *part)
            print(f"{name}: answered", flush=True)


def records(run: Path) -> dict[str, dict[str, Any]]:
    """The region of each frame, by the frame's name."""
    lines = (run / "regions.jsonl").read_text(encoding="utf-8").splitlines()
    return {record["frame"]: record for record in map(json.loads, lines)}


def numbers(value: Any) -> list[float]:
    """All numbers in a JSON value, in order; the unbounded ends of intervals are infinite."""
    if isinstance(value, dict):
        return [x for key in sorted(value) for x in numbers(value[key])]
    if isinstance(value, list):
        return [x for part in value for x in numbers(part)]
    return [] if isinstance(value, str) else [np.inf if value is None else float(value)]


def flattened(value: Any, name: str = "") -> dict[str, Any]:
    """Numbers of nested objects by their path; text is left out."""
    if isinstance(value, dict):
        return {key: x for part in value for key, x in flattened(value[part], f"{name}.{part}").items()}
    return {} if isinstance(value, str) else {name: value}


def largest_difference(one: Any, other: Any) -> float:
    """Largest absolute difference of the numbers in two JSON values; infinite where their shapes differ."""
    a, b = np.array(numbers(one)), np.array(numbers(other))
    if a.shape != b.shape or not np.array_equal(np.isinf(a), np.isinf(b)):
        return np.inf
    bounded = np.isfinite(a)
    return float(np.abs(a[bounded] - b[bounded]).max(initial=0.0))


def compare(old: Path, new: Path, names: list[str]) -> None:
    """Print how the answers differ: the regions and evidence of each frame, each trajectory, the metrics."""
    header = ["world", "frames", "evidence equal", "regions equal", "path regions equal"]
    rows, changed = [], []
    for name in names:
        runs = old / name / "run", new / name / "run"
        before, after = map(records, runs)
        if before.keys() != after.keys():
            raise SystemExit(f"{name}: {len(before)} and {len(after)} frames, or other frames")
        shares = [
            np.mean([largest_difference(before[f].get(key), after[f].get(key)) < ROUNDING for f in before])
            for key in ("intervals", "path_places")
        ]
        evidence = np.mean([before[f]["evidence"] == after[f]["evidence"] for f in before])
        poses = [np.loadtxt(run / "trajectory.tum", ndmin=2) for run in runs]
        gap = np.abs(poses[0] - poses[1])[:, 1:].max() if poses[0].shape == poses[1].shape else np.inf
        rows.append([name, str(len(before)), *(f"{share:.3f}" for share in (evidence, *shares)), f"{gap:.2g}"])
        metrics = [json.loads((run / "metrics.json").read_text(encoding="utf-8")) for run in runs]
        for key in ("errors", "coverage", "path_coverage"):
            pair = [flattened(values.get(key)) for values in metrics]
            for part in sorted(pair[0].keys() | pair[1].keys()):
                if largest_difference(*(side.get(part) for side in pair)) > ROUNDING:
                    changed.append(f"{name}, {key}{part}: {pair[0].get(part)} -> {pair[1].get(part)}")
    print(*table_lines([*header, "largest pose difference, m"], rows), "", sep="\n")
    print("\n".join(["metrics that differ:", *changed]) if changed else "all metrics are equal")


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("what", choices=["answer", "compare"])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--source", type=Path, default=ROOT / "src")
    parser.add_argument("--sources", default=SOURCES, help="pose sources of the models")
    parser.add_argument("--seed", type=int, default=0, help="of the trainings")
    parser.add_argument("--worlds", nargs="+", default=list(worlds(Path())), choices=list(worlds(Path())))
    options = parser.parse_args()
    if options.what == "answer":
        answer(options.folders[0], options.source, options.sources, options.seed, options.worlds)
    else:
        compare(*options.folders, options.worlds)


if __name__ == "__main__":
    main()
