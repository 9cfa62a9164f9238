"""Commands killed at random moments: earlier results whole, and the rerun as if nothing had happened.

python benchmarks/kill.py [MOMENTS] [COMMANDS]

Numbers of a command are kept in benchmarks/results/kill and not measured again.
"""

from __future__ import annotations

import json
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import RESULTS, ROOT, write_table

from conformodal.datasets.corridor.writer import write_corridor
from conformodal.running.results.provenance import provenance

MAIN = "from conformodal.cli.main import app; app()"
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
COMMANDS = ["train", "run", "calibrate", "data convert", "table1"]
NETWORKS = ",".join(["efficientnet_lite0"] * 3)


@dataclass(frozen=True)
class Case:
    """A command, what it starts from, and what of its results must be the same each time."""

    name: str
    arguments: list[object]
    out: Path
    result: Callable[[Path], object]
    before: Path | None = None  # earlier results, copied to `out` first


def command(arguments: list[object]) -> subprocess.Popen[bytes]:
    start = ["-m", "experiments.table1"] if arguments[0] == "table1" else ["-c", MAIN, str(arguments[0])]
    line = [sys.executable, *start, *map(str, arguments[1:])]
    return subprocess.Popen(line, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def contents(folder: Path, suffixes: tuple[str, ...] = ("",)) -> dict[str, bytes]:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name.endswith(suffixes))
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def radius(folder: Path) -> object:
    return json.loads((folder / "model.json").read_text())["radius"]


def errors(folder: Path) -> object:
    kept = ("row", "split", "seed", "method", "rmse_m", "rmse_deg")
    return [{k: r.get(k) for k in kept} for r in json.loads((folder / "table1.json").read_text())]


def prepare(root: Path) -> list[Case]:
    world, other, cache, model, ran = (root / name for name in ("world", "other", "cache", "model", "ran"))
    write_corridor(world, n_modules=2, n_laps=1, seed=3)
    write_corridor(other, n_modules=2, n_laps=1, seed=4)
    train = ["train", world, "--cache", cache, "--epochs", 60, "--sources", "head,neighbours", "--out"]
    run = ["run", model, world, "--part", "test", "--out"]
    for arguments in ([*train, model], [*run, ran]):
        if command(arguments).wait():
            raise SystemExit(f"failed: {arguments}")
    out = root / "out"
    table = ["table1", world, "--method", "paper", "--split", "interleaved", "--seeds", 1]
    table += ["--epochs", 5]
    results = ("regions.jsonl", ".tum")
    return [
        Case("train", [*train, out], out, lambda f: contents(f, (".safetensors",)), model),
        Case("run", [*run, out], out, lambda f: contents(f, results), ran),
        Case("calibrate", ["calibrate", out, other, "--cache", cache], out, radius, model),
        Case("data convert", ["data", "convert", world, "--to", "tum", "--out", out], out, contents),
        Case("table1", [*table, "--networks", NETWORKS, "--cache", cache, "--out", out], out, errors),
    ]


def fresh(case: Case) -> dict[str, bytes]:
    shutil.rmtree(case.out, ignore_errors=True)
    if case.before is None:
        return {}
    shutil.copytree(case.before, case.out)
    return contents(case.out)


def trial(case: Case, moment: float, number: signal.Signals, expected: object) -> tuple[bool, bool, bool]:
    """Whether no traceback was seen, earlier results were whole, and the rerun gave the expected."""
    before = fresh(case)
    process = command(case.arguments)
    time.sleep(moment)
    process.send_signal(number)
    said = process.communicate()[1]
    left = contents(case.out) if case.out.exists() else {}
    whole = process.returncode == 0 or all(left.get(name) == content for name, content in before.items())
    if not whole and case.out.exists():  # it was so far that the new results had taken their place
        with suppress(OSError, ValueError, KeyError):
            whole = case.result(case.out) == expected
    if number != signal.SIGKILL and case.name == "run" and not whole:  # stopped kindly: it has kept what it answered
        whole = json.loads(left["metrics.json"])["stopped"] == "interrupted"
    again = command(case.arguments)
    complaint = again.communicate()[1].decode(errors="replace")
    if again.returncode and "is not empty" in complaint:  # data convert writes into new folders only
        shutil.rmtree(case.out)
        again = command(case.arguments)
        again.communicate()
    same = again.returncode == 0 and case.result(case.out) == expected
    return b"Traceback" not in said, whole, same


def measured(case: Case, n_moments: int, rng: random.Random) -> dict[str, Any]:
    """Counts over the moments at which a command was killed."""
    fresh(case)
    started = time.perf_counter()
    if command(case.arguments).wait():
        raise SystemExit(f"failed: {case.name}")
    seconds = time.perf_counter() - started
    expected = case.result(case.out)
    found = [trial(case, rng.uniform(0, seconds), SIGNALS[k % len(SIGNALS)], expected) for k in range(n_moments)]
    quiet, whole, same = (sum(column) for column in zip(*found, strict=True))
    source = provenance()["source_revision"]
    return {"moments": n_moments, "seconds": seconds, "quiet": quiet, "whole": whole, "same": same, "source": source}


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 60
    asked, kept = sys.argv[2:] or COMMANDS, RESULTS / "kill"
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        for case in prepare(Path(scratch)):
            file = kept / f"{case.name.replace(' ', '-')}.json"
            if case.name in asked and not file.is_file():
                numbers = measured(case, n // len(COMMANDS), random.Random(case.name))
                file.write_text(json.dumps(numbers, indent=1) + "\n")
                print(case.name, numbers, flush=True)
    rows, sources = [], set()
    for name in COMMANDS:
        file = kept / f"{name.replace(' ', '-')}.json"
        if file.is_file():
            of = json.loads(file.read_text())
            sources.add(of["source"])
            rows.append([name, *(str(round(of[k])) for k in ("moments", "seconds", "quiet", "whole", "same"))])
    notes = (
        "Moments are drawn evenly over the time of an uninterrupted command, signals are SIGKILL, SIGTERM and SIGINT "
        "in turn. Earlier results: a model for train and calibrate, a run for run; whole too where the new ones had "
        "taken their place. Rerun: the same command once more; weights, regions, trajectories, radius and files must "
        "be the same to the bit, errors of table1 (`--method paper`) to the last digit. Measured with source "
        f"{', '.join(sorted(sources))}."
    )
    header = ["command", "moments", "seconds in all", "no traceback", "earlier results whole", "rerun the same"]
    line = shlex.join(["python", "benchmarks/kill.py", *sys.argv[1:]])
    write_table("kill", "Commands killed at random moments", line, header, rows, notes)


if __name__ == "__main__":
    main()
