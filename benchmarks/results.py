"""Measure every committed table again, from one revision: ``make results``.

python benchmarks/results.py [--only cameras peers] [--changed]

Two units at a time, timings alone. A unit that is finished, and what an interrupted one has measured, is kept in
results-out by the digest of the sources. Once all units are measured, README and docs quote the new numbers.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass

from common import ROOT, RUNS, parser_of

from conformodal.pipeline.provenance import provenance

CORES = 2


@dataclass(frozen=True)
class Unit:
    """A script that writes a table, and what it takes."""

    words: str  # of the command, after benchmarks/
    minutes: int
    cores: int = 1
    after: tuple[str, ...] = ()  # units whose models it uses


UNITS = {
    "cameras": Unit("cameras.py --seeds 40 41", 25, 2),
    "camera_ablations": Unit("cameras.py --ablations --seeds 40", 21, 2, ("cameras",)),
    "recordings": Unit("recordings.py", 6, 1, ("cameras",)),
    "unseen": Unit("unseen.py", 9),
    "accept": Unit("accept.py", 1, 1, ("cameras", "unseen")),
    "landmarks": Unit("landmarks.py", 5),
    "relative_motion": Unit("relative_motion.py", 1),
    "joint": Unit("joint.py", 3),
    "conditional": Unit("conditional.py", 1),
    "smooth_member": Unit("smooth_member.py", 2),
    "table_scores": Unit("table_scores.py", 6),
    "table_warnings": Unit("table_warnings.py", 3),
    "map_from_video": Unit("map_from_video.py", 9, 2),
    "camera_input": Unit("camera_input.py", 9),
    "peers": Unit("peers/run.py --measure", 40, 2),
    "growth": Unit("growth.py", 24, 2),
    "table1": Unit("table1.py --seeds 1 --first-seed 40", 28, 2),
    "extend": Unit("extend.py --simulated 1000", 15),
    "monitor": Unit("monitor.py --sequences 10000", 16),
    "score_stream": Unit("score_stream.py", 1),
    "long_stream": Unit("long_stream.py --frames 20000", 12),
    "costs": Unit("costs.py", 8, 2),  # timings: nothing beside it
    "streaming": Unit("streaming.py", 10, 2),
}


def start(name: str) -> subprocess.Popen[bytes]:
    """Begin a unit; its output goes to a file."""
    log = (RUNS / f"{name}.log").open("wb")
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    command = [sys.executable, *f"benchmarks/{UNITS[name].words}".split()]
    settings = {**os.environ, **threads, "CONFORMODAL_RUNS": str(RUNS)}
    return subprocess.Popen(command, cwd=ROOT, env=settings, stdout=log, stderr=subprocess.STDOUT)


def measure(left: list[str]) -> int:
    """Run units, as many at a time as there are cores for; returns how many failed."""
    running: dict[str, tuple[subprocess.Popen[bytes], float]] = {}
    failed: list[str] = []
    while left or running:
        free = CORES - sum(UNITS[name].cores for name in running)
        waiting = {*left, *running}
        ready = [name for name in left if UNITS[name].cores <= free and not waiting & {*UNITS[name].after}]
        if ready:
            left.remove(ready[0])
            running[ready[0]] = start(ready[0]), time.time()
            continue
        time.sleep(1)
        for name, (process, began) in list(running.items()):
            if process.poll() is None:
                continue
            del running[name]
            if process.returncode:
                failed.append(name)
            else:
                (RUNS / f"{name}.done").touch()
            minutes = sum(UNITS[one].minutes * UNITS[one].cores for one in (*left, *running)) / CORES
            how = f"failed, see {RUNS / name}.log" if process.returncode else "measured"
            print(f"{name}: {how} in {(time.time() - began) / 60:.0f} min, some {minutes:.0f} min left", flush=True)
    return len(failed)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--only", nargs="+", choices=UNITS, default=list(UNITS))
    parser.add_argument("--changed", action="store_true", help="measure a checkout with changes, to try")
    options = parser.parse_args()
    revision = str(provenance()["source_revision"])
    if revision.endswith("-dirty") and not options.changed:
        print("the checkout has changes: commit them, so that tables can name a revision, or give --changed")
        return 2
    RUNS.mkdir(parents=True, exist_ok=True)
    failed = measure([name for name in options.only if not (RUNS / f"{name}.done").is_file()])
    left = [name for name in UNITS if not (RUNS / f"{name}.done").is_file()]
    if left:  # quoting changes the checkout: what is measured afterwards would be of no revision
        print(f"left: {', '.join(left)}")
        return failed
    return subprocess.run([sys.executable, ROOT / "benchmarks" / "quotes.py", "--write"], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
