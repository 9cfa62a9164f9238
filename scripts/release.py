"""Make a release ready: ``python scripts/release.py VERSION``.

Sets the version, dates its section of the changelog, builds wheel and source distribution and tries both in empty
environments. The working tree is changed only if all of that goes well; nothing is tagged, pushed or uploaded: the
commands for that are printed. Needs the packages ``build`` and ``hatchling``.
"""

from __future__ import annotations

import argparse
import datetime
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NAME = "conformodal"
VERSION = re.compile(r"(\d+)\.(\d+)\.(\d+)(?:(a|b|rc)(\d+))?")
# Where the version stands: file, and the line that says it.
PLACES = {
    "pyproject.toml": re.compile(r'(?m)^version = "([^"\n]+)"$'),
    "CITATION.cff": re.compile(r"(?m)^version: (\S+)$"),
}
RELEASED = re.compile(r"(?m)^date-released: .*\n")
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
    said = [str(part) for part in command]
    done = subprocess.run(said, cwd=cwd, env=settings, capture_output=True, text=True, check=False)
    if (done.returncode != 0) is not fails:
        raise ReleaseError(f"{' '.join(said)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout + done.stderr


def order_of(version: str) -> tuple[int, int, int, str, int]:
    """What versions are compared by; a release comes after its candidates."""
    match = VERSION.fullmatch(version)
    if match is None:
        raise ReleaseError(f"{version!r} is no version such as 1.2.3 or 1.2.3rc1")
    return int(match[1]), int(match[2]), int(match[3]), match[4] or "z", int(match[5] or 0)


def new_texts(root: Path, version: str, day: str) -> dict[str, str]:
    """The files that say the version, as they will be."""
    texts = {name: (root / name).read_text(encoding="utf-8") for name in (*PLACES, "CHANGELOG.md")}
    for name, place in PLACES.items():
        found = place.findall(texts[name])
        if len(found) != 1:
            raise ReleaseError(f"{name}: says a version in {len(found)} lines, expected one")
        if order_of(version) < order_of(found[0]):
            raise ReleaseError(f"{name}: is at {found[0]} already, got {version}")
        texts[name] = place.sub(lambda match: match[0].replace(match[1], version), texts[name])
    cff = RELEASED.sub("", texts["CITATION.cff"])
    texts["CITATION.cff"] = cff.replace(f"version: {version}\n", f"version: {version}\ndate-released: {day}\n")
    section = f"## {version} (unreleased)\n"
    if texts["CHANGELOG.md"].count(section) != 1:
        raise ReleaseError(f"CHANGELOG.md: has no section {section.strip()!r}")
    texts["CHANGELOG.md"] = texts["CHANGELOG.md"].replace(section, f"## {version} ({day})\n")
    return texts


def check_clean(root: Path, version: str) -> None:
    """Refuse a tree with changes, and a version that has a tag."""
    changed = run("git", "status", "--porcelain", cwd=root)
    if changed:
        raise ReleaseError(f"the working tree is not clean:\n{changed}")
    if run("git", "tag", "--list", f"v{version}", cwd=root).strip():
        raise ReleaseError(f"the tag v{version} is there already")


def build(root: Path, out: Path) -> tuple[Path, Path]:
    """Wheel and source distribution; the wheel is built from the source distribution."""
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", out, root)
    return next(out.glob("*.whl")), next(out.glob("*.tar.gz"))


def environment(folder: Path, wheel: Path, *, offline: bool) -> Path:
    """Python of a new environment with the wheel and what it depends on alone.

    `offline` takes the latter from this Python's own packages, by links.
    """
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    windows = sys.platform == "win32"
    python = folder / ("Scripts" if windows else "bin") / ("python.exe" if windows else "python")
    alone = ("--no-deps", "--no-index") if offline else ()
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", *alone, wheel)
    if offline:
        site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
        requires = run(
            python, "-c", f"from importlib.metadata import requires as r; print('\\n'.join(r({NAME!r})))"
        ).splitlines()
        for distribution in needed([line for line in requires if "extra ==" not in line]):
            for top in {
                file.parts[0] for file in distribution.files or () if file.parts[0] not in ("..", "__pycache__")
            }:
                (site / top).symlink_to(Path(str(distribution.locate_file(top))))
    return python


def needed(requirements: list[str]) -> list[metadata.Distribution]:
    """Installed distributions that requirements name, and those that these need."""
    found: dict[str, metadata.Distribution] = {}
    left = list(requirements)
    while left:
        match = re.match(r"[A-Za-z0-9._-]+", left.pop())
        name = re.sub(r"[-_.]+", "-", match[0]).lower() if match else ""
        if name and name not in found:
            found[name] = metadata.distribution(name)
            left += [line for line in found[name].requires or [] if ";" not in line]
    return list(found.values())


def check(python: Path, version: str, place: Path) -> None:
    """Import, regress, and be told of the extra that the command line needs; in a folder without sources."""
    run(python, "-c", CHECK.format(version=version), cwd=place)
    command = python.with_name(f"{NAME}{python.suffix}")
    said = run(command, "--help", cwd=place, fails=True)
    if EXTRA not in said:
        raise ReleaseError(f"{command} --help does not name the extra that it needs ({EXTRA}):\n{said}")


def check_both(wheel: Path, source: Path, version: str, scratch: Path, *, offline: bool) -> None:
    """Try the wheel, and a wheel that is made of the source distribution, each in an environment of its own."""
    with tarfile.open(source) as archive:
        archive.extractall(scratch / "source", filter="data")
    (unpacked,) = (scratch / "source").iterdir()
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", scratch / "again", unpacked)
    (again,) = (scratch / "again").glob("*.whl")
    for name, file in (("wheel", wheel), ("source", again)):
        check(environment(scratch / f"env-{name}", file, offline=offline), version, scratch)


def release(root: Path, version: str, *, offline: bool, dry_run: bool) -> str:
    """Do all of it; returns what is left to do."""
    order_of(version)
    check_clean(root, version)
    texts = new_texts(root, version, datetime.datetime.now(tz=datetime.UTC).date().isoformat())
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        copy = scratch / "tree"
        for name in run("git", "ls-files", cwd=root).splitlines():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / name, copy / name)
        for name, text in texts.items():
            (copy / name).write_text(text, encoding="utf-8")
        files = build(copy, scratch / "dist")
        check_both(*files, version, scratch, offline=offline)
        if dry_run:
            return f"{version} can be released: {', '.join(file.name for file in files)} were built and tried\n"
        (root / "dist").mkdir(exist_ok=True)
        for file in files:
            shutil.copyfile(file, root / "dist" / file.name)
    for name, text in texts.items():
        (root / name).write_text(text, encoding="utf-8")
    return (
        f"{', '.join(file.name for file in files)} are in dist/, and {', '.join(texts)} say {version}. Left to do:\n"
        f"  git commit -am 'Release {version}'\n"
        f"  git tag -a v{version} -m 'conformodal {version}'\n"
    )


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("version", help="such as 1.2.3 or 1.2.3rc1")
    parser.add_argument("--dry-run", action="store_true", help="check everything, change nothing")
    parser.add_argument("--offline", action="store_true", help="take dependencies from this Python's own packages")
    asked = parser.parse_args(arguments)
    try:
        sys.stdout.write(release(ROOT, asked.version, offline=asked.offline, dry_run=asked.dry_run))
    except ReleaseError as exc:
        sys.stderr.write(f"error: {exc}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
