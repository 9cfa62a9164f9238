"""Tasks for engines; a module of its own, so that other processes can import it."""

import os
from dataclasses import dataclass
from pathlib import Path

from conformodal.experiments import ExperimentError


@dataclass(frozen=True)
class Square:
    number: int
    version: int = 1
    group: str = ""

    @property
    def key(self):
        return f"square-{self.number}"

    @property
    def settings(self):
        return {"number": self.number, "version": self.version, "shape": (1, 2)}


class Counting:
    """Squares numbers, remembers which, and may be interrupted."""

    def __init__(self, stop_at=None):
        self.done, self.stop_at = [], stop_at

    def __call__(self, task):
        if task.number == self.stop_at:
            raise KeyboardInterrupt
        self.done.append(task.number)
        return {"square": task.number**2}


@dataclass(frozen=True)
class Meeting:
    """Squares numbers in processes that wait for each other, so that two must work at the same time."""

    folder: Path
    seconds: float = 30.0

    def __call__(self, task):
        import time

        if task.number < 0:
            raise ExperimentError("numbers must not be negative")
        (self.folder / f"{os.getpid()}").touch()
        end = time.monotonic() + self.seconds
        while len(list(self.folder.iterdir())) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        return {"square": task.number**2, "process": os.getpid(), "threads": _threads()}


@dataclass(frozen=True)
class Lasting:
    """Says which process works, and works for two minutes."""

    folder: Path

    def __call__(self, task):
        import time

        (self.folder / f"{os.getpid()}").touch()
        time.sleep(120)
        return {"square": task.number**2}


class InStep:
    """Squares numbers in two processes that wait for each other at every task."""

    def __init__(self, folder):
        self.folder, self.n_done = folder, 0

    def __call__(self, task):
        import time

        self.n_done += 1
        (self.folder / f"{self.n_done}-{os.getpid()}").touch()
        end = time.monotonic() + 30
        while len(list(self.folder.glob(f"{self.n_done}-*"))) < 2 and time.monotonic() < end:
            time.sleep(0.02)
        return {"process": os.getpid()}


def _threads():
    """Of whichever library has the most."""
    import cv2
    import torch
    from threadpoolctl import threadpool_info

    return max(torch.get_num_threads(), cv2.getNumThreads(), *(pool["num_threads"] for pool in threadpool_info()))
