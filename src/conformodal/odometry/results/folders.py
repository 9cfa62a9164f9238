"""Which command a folder of results belongs to, and results that take the place of earlier ones all at once."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from conformodal.core.files import FolderError, write_whole, writing_in

from .records import METRICS, REGIONS, TRAJECTORY, TRUTH

# What a run writes, and what is made from it: these stay together or go together.
RESULTS = (REGIONS, "regions.parquet", TRAJECTORY, TRUTH, "methods", "report.html", "evaluation", METRICS)
UNFINISHED, FINISHED, _NAMES = "unfinished", "finished", "names.json"
_TELLING = {
    "train": ("model.json",),
    "reproduce": ("tasks", "table1.json"),
    "demo": ("corridor",),
    "run": (REGIONS, TRAJECTORY, TRUTH),
}
# What a command writes before all else, and what only later: the latter alone is somebody else's.
_WRITES = {
    "train": (("model.json",), ("weights.safetensors",)),
    "run": ((REGIONS, METRICS), (TRAJECTORY, TRUTH, "report.html")),
    "demo": (("corridor",), ("model", "report.html")),
    "reproduce": (("tasks", "table1.json", METRICS), ("table1.md", "table1.html", "table1.parquet")),
}
# The files of ours in folders that others may keep files in.
_OURS = {"methods": "*.tum", "evaluation": METRICS}
_SAID = {
    "train": "a model",
    "run": "results of run",
    "demo": "results of demo",
    "reproduce": "results of reproduce",
    "evaluate": "an evaluation",
    "data": "findings of data check",
    "bins": "a run of reproduce",
}


def owners(folder: Path) -> set[str]:
    """The commands whose results a folder holds, by their first word: by its files, and by what its metrics say."""
    found = {who for who, names in _TELLING.items() if any((folder / name).exists() for name in names)}
    said = _said(folder / METRICS)
    if said is not None and (said or not found):
        found.add(said)
    if found & {"demo", "bins"}:  # these write a run, and more
        found.discard("run")
    return found


def check_owner(folder: Path, command: str) -> None:
    """Refuse a folder that holds results of another command.

    Raises
    ------
    FolderError
        If it does; names both.
    """
    mine = command.split(maxsplit=1)[0]
    allowed = {mine, "run"} if mine == "bins" else {mine}
    for other in sorted(owners(folder) - allowed):
        what = _SAID.get(other, "a metrics.json of unknown origin")
        raise FolderError(f"{folder}: holds {what}, which {mine} would overwrite; take another folder, or empty it")


def check_no_stray(folder: Path, command: str) -> None:
    """Refuse a folder with files of the names that a command writes, where it has not written any: they would be lost.

    Raises
    ------
    FolderError
        If there is one.
    """
    first, later = _WRITES[command]
    stray = [name for name in later if (folder / name).exists()]
    if stray and not any((folder / name).exists() for name in first):
        raise FolderError(
            f"{folder / stray[0]}: was not written by {command}, which would overwrite it; take another folder"
        )


@contextmanager
def claimed(folder: Path, command: str, apart: Iterable[Path] = ()) -> Iterator[None]:
    """Claim a folder for the results of a command: writable, without results of another, and locked.

    Parameters
    ----------
    folder
        Made if missing.
    command
        Whose results it gets.
    apart
        Folders that are read, and so must be others.

    Raises
    ------
    FolderError
        If it cannot be written, holds results of another command, is in use, or is one of those that are read.
    """
    for other in apart:
        if other.is_dir() and folder.exists() and folder.samefile(other):
            raise FolderError(f"{folder}: is read from, so results cannot be written there; take another folder")
    with writing_in(folder):
        check_owner(folder, command)
        settle(folder)
        yield


def holds_results(folder: Path) -> bool:
    """Whether there are results of a run, whole or not."""
    return any((folder / name).exists() for name in RESULTS)


def replace_results(folder: Path) -> None:
    """Let the results under ``unfinished`` take the place of those in the folder, and of all that was made from these.

    From the renaming on they are the folder's results: where a process dies in the middle, :func:`settle` goes on.
    """
    new = folder / UNFINISHED
    write_whole(new / _NAMES, json.dumps([name for name in RESULTS if (new / name).exists()]))
    new.rename(folder / FINISHED)
    settle(folder)


def settle(folder: Path) -> None:
    """Complete a replacement of results that another process had begun."""
    new = folder / FINISHED
    kept = _names_in(new)
    if kept is None:
        return
    for name in RESULTS:
        if name not in kept:
            _remove(folder / name)
        elif (new / name).is_dir():
            _remove(folder / name)
            (folder / name).mkdir(exist_ok=True)
            for path in (new / name).iterdir():
                path.replace(folder / name / path.name)
            (new / name).rmdir()
        elif (new / name).exists():
            (new / name).replace(folder / name)
    shutil.rmtree(new)


def _names_in(new: Path) -> list[str] | None:
    """The names of the results that a process had begun to move; None where none had.

    Raises
    ------
    FolderError
        If something else is in their place, or the names are damaged: nothing is moved or removed then.
    """
    path = new / _NAMES
    if not path.is_file():
        if new.is_file() or (new.is_dir() and any(new.iterdir())):
            raise FolderError(f"{new}: was not written by run, which needs that name; take another folder")
        return None
    try:
        names = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(name in RESULTS for name in names):
        raise FolderError(
            f"{path}: is damaged, so it is not known which results take the place of those in {new.parent}; move "
            f"what {new} holds to another folder, or remove it"
        )
    return names


def discard(folder: Path) -> None:
    """Remove results."""
    for name in RESULTS:
        _remove(folder / name)


def result_digests(folder: Path) -> dict[str, str]:
    """Digests of the files that numbers about a run rest on."""
    paths = [folder / name for name in (REGIONS, TRAJECTORY)]
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in paths if p.is_file()}


def check_belongs(folder: Path, metrics: dict[str, Any]) -> None:
    """Refuse metrics that were written for other results than those beside them.

    Raises
    ------
    FolderError
        If a digest differs; names the file.
    """
    here = result_digests(folder)
    for name, digest in (metrics.get("results") or {}).items():
        if here.get(name) != digest:
            raise FolderError(f"{folder / name}: is not the file that {METRICS} beside it was written for")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        for own in path.glob(_OURS.get(path.name, "*")):
            own.unlink()
        with suppress(OSError):  # someone else keeps something there
            path.rmdir()
    else:
        path.unlink(missing_ok=True)


def _said(metrics: Path) -> str | None:
    """First word of the command in a ``metrics.json``; empty where it cannot be read, None where there is none."""
    try:
        record = json.loads(metrics.read_text(encoding="utf-8"))
        return str(record["command"]).split()[0]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError):
        return ""
