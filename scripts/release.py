"""Try a release: ``python scripts/release.py VERSION``.

Checks that the files that say the version agree and that all tables of results are of today's source, builds wheel and
source distribution into ``dist``, and tries the wheel, which is built from the source distribution, in an empty
environment. Nothing is tagged, pushed or uploaded.
Needs the packages ``build`` and ``hatchling``.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NAME = "conformodal"
# Where the version stands: file, and the line that says it.
PLACES = {
    "pyproject.toml": re.compile(r'(?m)^version = "([^"\n]+)"$'),
    "CITATION.cff": re.compile(r"(?m)^version: (\S+)$"),
    "CHANGELOG.md": re.compile(r"(?m)\A# Changelog\n(?:(?!## ).*\n)*## (\S+) \(\d{4}-\d\d-\d\d\)$"),
}
CHECK = """
import numpy, conformodal
assert conformodal.__version__ == {version!r}, conformodal.__version__
x = numpy.linspace(0, 1, 200)[:, None]
conformodal.ConformalRegressor(random_state=0).fit(x, x[:, 0]).predict_region(x[:3]).intervals(0)
"""
EXTRA = f"pip install '{NAME}[run]'"


class ReleaseError(Exception):
    """A release that cannot be made; says why."""


def run(*command: str | Path, cwd: Path | None = None, fails: bool = False) -> str:
    """What a command prints; an error if it fails, or with `fails` if it does not."""
    # what lies in the source must not stand in for what was installed
    settings = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [str(part) for part in command]
    done = subprocess.run(words, cwd=cwd, env=settings, capture_output=True, text=True, check=False)
    if (done.returncode != 0) is not fails:
        raise ReleaseError(f"{' '.join(words)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def check_places(root: Path, version: str) -> None:
    """Refuse a version that not all files say, an undated section of the changelog, and a tree with changes."""
    for name, place in PLACES.items():
        if place.findall((root / name).read_text(encoding="utf-8")) != [version]:
            raise ReleaseError(f"{name}: does not say {version}, or the changelog's section has no date")
    changed = run("git", "status", "--porcelain", cwd=root)
    if changed:
        raise ReleaseError(f"the working tree is not clean:\n{changed}")


def build(root: Path, out: Path) -> tuple[Path, Path]:
    """Wheel and source distribution; the wheel is built from the source distribution."""
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, root)
    return next(out.glob("*.whl")), next(out.glob("*.tar.gz"))


def environment(folder: Path, wheel: Path, *, offline: bool) -> Path:
    """Python of a new environment with the wheel and what it depends on alone.

    `offline` takes the latter from this Python's own packages, by links.
    """
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    python = folder / "bin" / "python"
    alone = ("--no-deps", "--no-index") if offline else ()
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", *alone, wheel)
    if offline:
        site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
        lines = run(python, "-c", f"from importlib.metadata import requires as r; print('\\n'.join(r({NAME!r})))")
        for distribution in needed([line for line in lines.splitlines() if "extra ==" not in line]):
            for top in {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
                (site / top).symlink_to(Path(str(distribution.locate_file(top))))
    return python


def needed(requirements: list[str]) -> list[metadata.Distribution]:
    """Installed distributions that requirements name, and those that these need."""
    distributions: dict[str, metadata.Distribution] = {}
    left = list(requirements)
    while left:
        match = re.match(r"[A-Za-z0-9._-]+", left.pop())
        name = re.sub(r"[-_.]+", "-", match[0]).lower() if match else ""
        if name and name not in distributions:
            distributions[name] = metadata.distribution(name)
            left += [line for line in distributions[name].requires or [] if ";" not in line]
    return list(distributions.values())


def check(python: Path, version: str, place: Path) -> None:
    """Import, regress, and be told of the extra that the command line needs; in a folder without sources."""
    run(python, "-c", CHECK.format(version=version), cwd=place)
    command = python.with_name(NAME)
    told = run(command, "--help", cwd=place, fails=True)
    if EXTRA not in told:
        raise ReleaseError(f"{command} --help does not name the extra that it needs ({EXTRA}):\n{told}")


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("version", help="such as 1.2.3 or 1.2.3rc1")
    parser.add_argument("--offline", action="store_true", help="take dependencies from this Python's own packages")
    asked = parser.parse_args(arguments)
    try:
        check_places(ROOT, asked.version)
        run(sys.executable, ROOT / "benchmarks" / "quotes.py", "--release")
        wheel, _ = build(ROOT, ROOT / "dist")
        with tempfile.TemporaryDirectory() as scratch:
            check(environment(Path(scratch) / "env", wheel, offline=asked.offline), asked.version, Path(scratch))
    except ReleaseError as exc:
        sys.stderr.write(f"error: {exc}\n")
        return 2
    sys.stdout.write(f"{wheel} works. Left to do: git tag -a v{asked.version} -m '{NAME} {asked.version}'\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
