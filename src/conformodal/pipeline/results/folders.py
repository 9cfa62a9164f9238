"""Which command a folder of results belongs to, and results that take the place of earlier ones all at once."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from conformodal.core.files import FolderError, writing_in

from .records import METRICS, REGIONS, TRAJECTORY, TRUTH

# What a run writes, and what is made from it: these stay together or go together.
RESULTS = (
    REGIONS, "regions.parquet", TRAJECTORY, TRUTH, "methods/*.tum", "report.html", f"evaluation/{METRICS}", METRICS,
)  # fmt: skip
UNFINISHED = "unfinished"
# New results that are complete, before and after the earlier ones are removed.
_COMPLETE, _MOVING = ".conformodal-complete", ".conformodal-moving"
# What a command's results are called; what it writes before all else; and what later, which alone is somebody else's.
_COMMANDS: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "train": ("a model", ("model.json",), ("weights.safetensors",)),
    "run": ("results of run", (REGIONS,), (TRAJECTORY, TRUTH, "report.html")),
    "demo": ("results of demo", ("corridor",), ("model", "report.html")),
    "reproduce": (
        "results of reproduce", ("tasks", "table1.json"), ("table1.md", "table1.html", "table1.parquet"),
    ),
    "evaluate": ("an evaluation", (), ()),
    "data": ("findings of data check", (), ("report.html",)),
    "bins": ("a run of reproduce", (), ()),
}  # fmt: skip


def check_owner(folder: Path, command: str) -> None:
    """Refuse a folder that holds results of another command, by its files or by what its metrics say."""
    mine = command.split(maxsplit=1)[0]
    for other in sorted(_lock_holders(folder) - ({mine, "run"} if mine == "bins" else {mine})):
        what = _COMMANDS[other][0] if other in _COMMANDS else "a metrics.json of unknown origin"
        raise FolderError(f"{folder}: holds {what}, which {mine} would overwrite; take another folder, or empty it")


def _lock_holders(folder: Path) -> set[str]:
    found = {who for who, (_, first, _) in _COMMANDS.items() if any((folder / name).exists() for name in first)}
    try:
        found.add(str(json.loads((folder / METRICS).read_text(encoding="utf-8"))["command"]).split()[0])
    except FileNotFoundError:
        pass
    except (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError):
        found = found or {""}
    return found - {"run"} if found & {"demo", "bins"} else found  # these write a run, and more


@contextmanager
def lock_output(folder: Path, command: str, apart: Iterable[Path] = ()) -> Iterator[None]:
    """Lock a folder for the results of a command; it is writable, and no file of anything else would be overwritten.

    It is made if missing. Folders `apart` are read, and so must be others.

    Raises
    ------
    FolderError
        If it cannot be written, holds something that is not of this command, is in use, or is one of those that are
        read.
    """
    for other in apart:
        if other.is_dir() and folder.exists() and folder.samefile(other):
            raise FolderError(f"{folder}: is read from, so results cannot be written there; take another folder")
    with writing_in(folder):
        check_owner(folder, command)
        _, _, later = _COMMANDS.get(command, ("", (), ()))
        stray = [name for name in later if (folder / name).exists()]
        if stray and not _lock_holders(folder):
            raise FolderError(
                f"{folder / stray[0]}: was not written by {command}, which would overwrite it; take another folder"
            )
        recover(folder)
        yield


def holds_results(folder: Path) -> bool:
    """Whether there are results of a run, whole or not."""
    return any(any(folder.glob(name)) for name in RESULTS)


def replace_results(folder: Path) -> None:
    """Let the complete results under ``unfinished`` take the place of the earlier ones, and of what was made of these.

    Where a process dies in the middle, :func:`recover` goes on.
    """
    (folder / UNFINISHED).rename(folder / _COMPLETE)
    recover(folder)


def recover(folder: Path) -> None:
    """Complete a replacement of results that another process had begun."""
    if (folder / _COMPLETE).is_dir():
        discard(folder)
        (folder / _COMPLETE).rename(folder / _MOVING)
    for path in [path for path in (folder / _MOVING).rglob("*") if path.is_file()]:
        target = folder / path.relative_to(folder / _MOVING)
        target.parent.mkdir(exist_ok=True)
        path.replace(target)
    shutil.rmtree(folder / _MOVING, ignore_errors=True)


def discard(folder: Path) -> None:
    """Remove results; files of others that lie among them stay."""
    for name in RESULTS:
        for path in list(folder.glob(name)):
            path.unlink()
    for name in ("methods", "evaluation"):
        with suppress(OSError):
            (folder / name).rmdir()


def result_digests(folder: Path) -> dict[str, str]:
    """Digests of the files that numbers about a run rest on."""
    paths = [folder / name for name in (REGIONS, TRAJECTORY)]
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in paths if p.is_file()}


def check_belongs(folder: Path, metrics: dict[str, Any]) -> None:
    """Refuse metrics that were written for other results than those beside them."""
    here = result_digests(folder)
    for name, digest in (metrics.get("results") or {}).items():
        if here.get(name) != digest:
            raise FolderError(f"{folder / name}: is not the file that {METRICS} beside it was written for")
