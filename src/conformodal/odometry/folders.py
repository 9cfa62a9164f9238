"""Which command a folder of results belongs to, and results that take the place of earlier ones all at once."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from conformodal._files import FolderError, write_whole, writing_in

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


def check_no_stray(folder: Path) -> None:
    """Refuse a folder with a trajectory that no run wrote: it would be lost.

    Raises
    ------
    FolderError
        If there is one.
    """
    stray = [name for name in (TRAJECTORY, TRUTH) if (folder / name).exists()]
    if stray and not any((folder / name).exists() for name in (REGIONS, METRICS)):
        raise FolderError(f"{folder / stray[0]}: was not written by run, which would overwrite it; take another folder")


@contextmanager
def claimed(folder: Path, command: str, apart: Iterable[Path] = ()) -> Iterator[None]:
    """Have a folder for the results of a command: usable, nobody else's, and locked; see :func:`writing_in`.

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
    """Bring a replacement of results to its end that a process had begun."""
    new = folder / FINISHED
    if not (new / _NAMES).is_file():
        return
    kept = json.loads((new / _NAMES).read_text(encoding="utf-8"))
    for name in RESULTS:
        if name not in kept:
            _remove(folder / name)
        elif (new / name).exists():
            if (new / name).is_dir():
                _remove(folder / name)
            (new / name).replace(folder / name)
    shutil.rmtree(new)


def discard(folder: Path, names: Iterable[str] = RESULTS) -> None:
    """Remove results."""
    for name in names:
        _remove(folder / name)


def result_digests(folder: Path) -> dict[str, str]:
    """Digests of the files that numbers about a run rest on."""
    paths = [folder / name for name in (REGIONS, TRAJECTORY)]
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in paths if p.is_file()}


def check_belongs(folder: Path, metrics: dict[str, Any]) -> None:
    """Refuse numbers about other results than those beside them.

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
        shutil.rmtree(path)
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
