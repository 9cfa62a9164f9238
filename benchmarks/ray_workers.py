"""``experiments.table1 --engine ray`` on a cluster of two nodes: seconds at one, two and four workers.

python benchmarks/ray_workers.py [--frames 240] [--epochs 10]

Both nodes are on this machine and share its cores: with two cores, four workers cannot be quicker than two.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from common import DATA, ROOT, write_page

NETWORK = "efficientnet_lite0"


def some_frames(source: Path, folder: Path, n: int) -> Path:
    """The first n frames of a recording, as a data set of their own."""
    (folder / "seq-01").mkdir(parents=True)
    for path in sorted(source.iterdir()):
        number = path.name.removeprefix("frame-").split(".")[0]
        if number.isdigit() and int(number) < n:
            shutil.copy(path, folder / "seq-01")
    return folder


def table1(data: Path, out: Path, cache: Path, epochs: int, *engine: str) -> float:
    """Seconds of one run, by its own account."""
    command = [sys.executable, "-m", "experiments.table1", str(data), "--out", str(out)]
    command += ["--cache", str(cache), "--method", "paper", "--seeds", "2", "--split", "interleaved"]
    command += ["--networks", ",".join([NETWORK] * 3), "--epochs", str(epochs), *engine]
    subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    found: float = json.loads((out / "metrics.json").read_text(encoding="utf-8"))["seconds"]
    return found


def on_cluster(cpus: list[int], data: Path, out: Path, cache: Path, epochs: int) -> float:
    """Seconds on a new cluster whose nodes have so many CPUs."""
    from ray.cluster_utils import Cluster  # noqa: PLC0415 - an extra

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    try:
        for n in cpus:
            cluster.add_node(num_cpus=n)
        return table1(data, out, cache, epochs, "--engine", "ray", "--address", cluster.address)
    finally:
        cluster.shutdown()


def errors(out: Path) -> dict[str, float]:
    """Position errors of a table, to six digits, by row, split, seed and method."""
    rows = json.loads((out / "table1.json").read_text(encoding="utf-8"))
    return {"/".join(str(row[k]) for k in ("row", "split", "seed", "method")): round(row["rmse_m"], 6) for row in rows}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--epochs", type=int, default=10)
    asked = parser.parse_args()
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])  # of the nodes
    lines = ["| workers | nodes | seconds | times as fast as one |", "| --- | --- | --- | --- |"]
    with tempfile.TemporaryDirectory() as scratch:
        here = Path(scratch)
        data = some_frames(DATA / "7scenes" / "redkitchen" / "seq-01", here / "data", asked.frames)
        table1(data, here / "local", here / "cache", asked.epochs)  # features into the cache
        expected, first = errors(here / "local"), 0.0
        for cpus in ([1], [1, 1], [2, 2]):
            out = here / f"out-{sum(cpus)}"
            seconds = on_cluster(cpus, data, out, here / "cache", asked.epochs)
            if errors(out) != expected:
                raise SystemExit(f"{sum(cpus)} workers give another table than this machine alone")
            first = first or seconds
            lines.append(f"| {sum(cpus)} | {len(cpus)} | {seconds:.1f} | {first / seconds:.2f} |")
            print(lines[-1], flush=True)
        n_tasks = len(list((here / "local" / "tasks").iterdir()))
    lines += [
        "",
        f"`experiments.table1 --method paper --seeds 2 --split interleaved --epochs {asked.epochs}` on {asked.frames} "
        f"frames of redkitchen, {NETWORK}, features cached, {n_tasks} tasks; from the data set to the table, with the "
        f"start of the workers. Both nodes are on this machine and share its {os.cpu_count()} cores. All errors are "
        "those of a run without Ray.",
    ]
    write_page("ray_workers", "The paper's table on a Ray cluster", "python benchmarks/ray_workers.py", lines)


if __name__ == "__main__":
    main()
