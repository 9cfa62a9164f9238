"""Results written as they come, so that a run that is stopped has kept all before."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

from conformodal.geometry import Trajectory
from conformodal.io.pose_files import TUM_HEADER, tum_lines
from conformodal.pipeline.model import METHODS

from .folders import UNFINISHED, discard, holds_results, lock_output, replace_results
from .records import REGIONS, TRAJECTORY, TRUTH


class ResultsWriter:
    """Writes ``regions.jsonl``, ``trajectory.tum`` (the answer), ``methods/NAME.tum`` and ``truth.tum``.

    Where the folder holds results already, new ones are written under ``unfinished`` in it, and take their place all
    together at the end. If an error ends the work, earlier results stay, and the new ones stay where they were written.

    The folder is created if missing, and locked until the end. `answer` is the method whose poses are the answer.

    Attributes
    ----------
    place
        Where files are until :meth:`close`; what belongs to the results is written there too.

    Raises
    ------
    FolderError
        If the folder cannot be written, holds something else than results of this command, or is in use.
    """

    def __init__(self, folder: Path, command: str = "run", answer: str = METHODS[0]) -> None:
        self.folder = self.place = folder
        self.answer = answer
        self._open: dict[str, TextIO] = {}
        self._n_regions = 0
        self._claim = ExitStack()
        self._claim.enter_context(lock_output(folder, command))
        try:
            if holds_results(folder):
                self.place = folder / UNFINISHED
                shutil.rmtree(self.place, ignore_errors=True)
            (self.place / "methods").mkdir(parents=True, exist_ok=True)
            self._lines(REGIONS, [])
        except BaseException:
            self._claim.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._break_off()

    def region(self, record: dict[str, Any]) -> None:
        """Write the region of the next frame, from :func:`~conformodal.pipeline.results.records.region_record`."""
        self._lines(REGIONS, [json.dumps(record)])
        self._n_regions += 1

    def poses(self, method: str, trajectory: Trajectory) -> None:
        """Write the next poses of a method."""
        self._lines(TRAJECTORY if method == self.answer else f"methods/{method}.tum", tum_lines(trajectory))

    def truth(self, trajectory: Trajectory) -> None:
        """Write the next true poses."""
        self._lines(TRUTH, tum_lines(trajectory))

    def close(self) -> None:
        """Close all files, and let them replace earlier results."""
        with self._claim:
            while self._open:
                self._open.popitem()[1].close()
            if self.place != self.folder:
                self.place = self.folder
                replace_results(self.folder)

    def _break_off(self) -> None:
        """Keep the answers so far; if there are none, remove what was begun."""
        with self._claim:
            while self._open:
                with suppress(OSError):  # the disk may be full: what broke off the work is told
                    self._open.popitem()[1].close()
            if not self._n_regions:
                discard(self.place)
            if not self._n_regions and self.place != self.folder:
                self.place.rmdir()

    def _lines(self, name: str, lines: Sequence[str]) -> None:
        if name not in self._open:
            # line buffered, so that others can follow a run
            self._open[name] = (self.place / name).open("w", encoding="utf-8", buffering=1)
            if name.endswith(".tum"):
                self._open[name].write(f"{TUM_HEADER}\n")
        self._open[name].writelines(f"{line}\n" for line in lines)
