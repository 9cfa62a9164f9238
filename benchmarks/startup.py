"""What a user waits for before any work: imports, help, and the checks of options, outputs and caches.

python benchmarks/startup.py [--install]

`--install` also builds the wheel, installs it with no extra and with `run` in environments of their own, and weighs
them. It downloads packages.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import ROOT, spread, write_table

REPEATS = 9
START = [sys.executable, "-c", "from conformodal.cli import main; main()"]
# Of each verb a call that passes all checks of options and outputs, and is then refused for its data set or model.
REFUSED = {
    "train": ["train", "{missing}", "--out", "{out}"],
    "run": ["run", "{missing}", "{missing}", "--out", "{out}"],
    "calibrate": ["calibrate", "{missing}", "{missing}"],
    "evaluate": ["evaluate", "{missing}", "--truth", "{missing}"],
    "data convert": ["data", "convert", "{missing}", "--out", "{out}"],
}
# In a process that has imported what the verb needs, so that the checks alone are timed.
CHECKS = """
import sys, time
from typer.testing import CliRunner
from conformodal.cli.main import app
call = sys.argv[1:]
first = CliRunner().invoke(app, call)
assert first.exit_code not in (0, 1, 70), first.output
started = time.perf_counter()
CliRunner().invoke(app, call)
print(time.perf_counter() - started)
"""


def seconds_of(command: list[str]) -> float:
    started = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - started


def check_seconds(verb: str, folder: Path) -> float:
    names = {"missing": str(folder / "missing"), "out": str(folder / "out")}
    call = [word.format(**names) for word in REFUSED[verb]]
    done = subprocess.run([sys.executable, "-c", CHECKS, *call], check=True, capture_output=True, text=True)
    return float(done.stdout)


def installed_mb(extra: str) -> float:
    """Size of an environment with the wheel and one extra, less that of an empty one."""
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch)
        subprocess.run([sys.executable, "-m", "build", "--wheel", "--outdir", place, ROOT], check=True, stdout=2)
        (wheel,) = place.glob("*.whl")
        subprocess.run([sys.executable, "-m", "venv", place / "env"], check=True)
        empty = _bytes_below(place / "env")
        what = f"{wheel}[{extra}]" if extra else str(wheel)
        subprocess.run([place / "env" / "bin" / "pip", "install", "--quiet", "--no-compile", what], check=True)
        return (_bytes_below(place / "env") - empty) / 1e6


def _bytes_below(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--install", action="store_true", help="weigh the installed packages too")
    asked = parser.parse_args()
    whole = {
        "python -c pass": [sys.executable, "-c", "pass"],
        "import conformodal": [sys.executable, "-c", "import conformodal"],
        "import conformodal, its ConformalRegressor": [
            sys.executable,
            "-c",
            "import conformodal as c; c.ConformalRegressor",
        ],
        "conformodal --help": [*START, "--help"],
        "conformodal train --help": [*START, "train", "--help"],
    }
    rows = [[name, "s, whole process", spread([seconds_of(c) for _ in range(REPEATS)], 2)] for name, c in whole.items()]
    with tempfile.TemporaryDirectory() as scratch:
        for verb in REFUSED:
            found = [check_seconds(verb, Path(scratch)) for _ in range(REPEATS)]
            rows.append([f"checks of `{verb}`", "s, imports done", spread(found, 3)])
    if asked.install:
        extras = {"conformodal": "", "conformodal[run]": "run"}
        rows += [
            [f"pip install {name}", "MB, without byte code", f"{installed_mb(e):.0f}"] for name, e in extras.items()
        ]
    write_table(
        "startup",
        "Before any work",
        "python benchmarks/startup.py" + (" --install" if asked.install else ""),
        ["what", "unit", "median (range)"],
        rows,
        f"{REPEATS} runs each. Checks: from the call of a verb to the refusal of a missing data set or model; "
        "all options, outputs and caches are checked before.",
    )


if __name__ == "__main__":
    main()
