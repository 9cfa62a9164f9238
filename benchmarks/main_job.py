"""The main job over several seeds: the corridor demo, and redkitchen with both splits.

python benchmarks/main_job.py [--seeds 3]
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

from common import DATA, spread, write_table

METHODS = ("smoothed", "viterbi", "greedy", "softmax_mean", "classical", "classical_smoothed")


def run(*arguments: object) -> float:
    started = time.perf_counter()
    command = [str(Path(sys.executable).parent / "conformodal"), *map(str, arguments)]
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - started


def metrics_of(folder: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return loaded


def _inside_band(coverage: dict[str, Any]) -> bool:
    """Whether the whole pose's coverage lies inside its 99 % band; False where no band is stated."""
    band = coverage["joint_band_99"]
    return band is not None and band[0] <= coverage["joint_coverage"] <= band[1]


def _seconds(results: list[dict[str, Any]]) -> str:
    return ", ".join(f"{r['wall']:.0f}" for r in results)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        for seed in seeds:
            seconds = run("demo", "--out", root / f"demo{seed}", "--seed", seed)
            found["corridor, interleaved"].append({**metrics_of(root / f"demo{seed}"), "wall": seconds})
        video = DATA / "7scenes" / "redkitchen" / "seq-01"
        for split in ("interleaved", "blocks"):
            for seed in seeds:
                model, out = root / f"{split}{seed}", root / f"{split}{seed}-out"
                cache = ["--cache", root / "cache"]
                seconds = run("train", video, "--out", model, "--split", split, "--seed", seed, "--classical", *cache)
                run("run", model, video, "--out", out, "--part", "test")
                found[f"redkitchen, {split}"].append({**metrics_of(out), "wall": seconds})
    rows = []
    for name, results in found.items():
        for method in METHODS:
            errors = [r["errors"][method] for r in results]
            ratios = [r["errors"]["classical"]["rmse_m"] / r["errors"][method]["rmse_m"] for r in results]
            metres, degrees = spread([e["rmse_m"] for e in errors]), spread([e["rmse_deg"] for e in errors], 2)
            rows.append([name, method, metres, degrees, spread(ratios, 2)])
    notes = []
    for name, results in found.items():
        inside = sum(_inside_band(r["coverage"]) for r in results)
        joint = spread([r["coverage"]["joint_coverage"] for r in results], 3)
        alpha = results[0]["coverage"]["alpha"]
        line = f"- {name}: whole pose covered {joint} at alpha = {alpha} ({results[0]['coverage']['joint']})"
        if "interleaved" in name:
            line += f"; inside its 99 % band in {inside} of {len(results)} seeds"
        else:
            line += "; not exchangeable, so nothing is promised"
        if "ambiguity" in results[0]:
            line += f"; look-alike places held {spread([r['ambiguity']['share_held'] for r in results], 3)}"
        what = "whole demo" if "corridor" in name else "training with the classical regressor (the first without cache)"
        notes.append(f"{line}; {what}: {_seconds(results)} s.")
    header = ["data, split", "method", "rmse_m", "rmse_deg", "classical / method"]
    title = "The main job: median and range over seeds"
    write_table("main_job", title, "python benchmarks/main_job.py", header, rows, "\n".join(notes))


if __name__ == "__main__":
    main()
