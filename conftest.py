"""Shared fixtures: where real data lies, and one small model on one small corridor for all tests that need one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import pytest
from hypothesis import settings

# The same examples every time, so that main does not depend on luck; HYPOTHESIS_PROFILE=default searches anew.
settings.register_profile("repeatable", derandomize=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


def pytest_collection_finish() -> None:  # not before coverage has begun
    """Processes that test at the same time share the cores."""
    n_workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if n_workers > 1:
        from experiments.tasks import limit_threads

        limit_threads(max(1, (os.cpu_count() or 1) // n_workers))


# files that take longest: begun first, so that at the end no process waits for another
LONGEST = ("test_acceptance.py", "test_table1.py", "test_extend.py", "test_map.py", "test_streaming.py", "test_cli.py")


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files come first; what needs the small model waits for its training."""
    items.sort(key=lambda item: LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST))
    for item in items:
        if "small_world" in getattr(item, "fixturenames", ()):
            item.add_marker("slow")
            item.add_marker("trained")


DATA = Path(os.environ.get("CONFORMODAL_DATA", Path(__file__).resolve().parents[1] / "shared" / "data"))


@pytest.fixture(scope="session")
def real_data() -> Callable[..., Path]:
    """Gives paths in the folder of real data; the test is skipped where one is missing."""

    def path_of(*parts: str) -> Path:
        path = DATA.joinpath(*parts)
        if not path.exists():
            pytest.skip(f"real data is missing: {path} (set CONFORMODAL_DATA)")
        return path

    return path_of


@pytest.fixture(scope="session")
def redkitchen(real_data: Callable[..., Path]) -> Path:
    return real_data("7scenes", "redkitchen", "seq-01")


MadeOnce: TypeAlias = Callable[[str, Callable[[Path], object]], Path]


@dataclass(frozen=True)
class SmallWorld:
    folder: Path
    cache: Path
    model: Path


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> MadeOnce:
    """Gives a folder that all processes which test at the same time share; the first that needs it fills it.

    The others wait. Where the first fails, or is killed, the next one begins anew.
    """
    from filelock import FileLock

    own = tmp_path_factory.getbasetemp()
    root = own.parent if "PYTEST_XDIST_WORKER" in os.environ else own

    def folder_of(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = root / name, root / f"{name}.done"
        with FileLock(root / f"{name}.lock"):
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return folder_of


@pytest.fixture(scope="session")
def small_corridor(made_once: MadeOnce) -> Path:
    """A corridor of three modules flown once, in 344 frames."""
    from conformodal.corridor import CorridorWorld, Renderer, drone_path, write_flight

    def fly(folder: Path) -> None:
        world = CorridorWorld(3, seed=3)
        poses = drone_path(world, 1, seed=3, speed=2.0).poses_se3
        write_flight(folder / "corridor" / "seq-01", Renderer(world), poses, noise_seed=3_000_009)

    return made_once("flown", fly) / "corridor"


@pytest.fixture(scope="session")
def small_world(small_corridor: Path, made_once: MadeOnce) -> SmallWorld:
    """The small corridor and a model trained on it through the command line."""

    def train(folder: Path) -> None:
        from typer.testing import CliRunner

        from conformodal.cli.main import app
        from tests.helpers import few_left_out

        arguments = ["train", small_corridor, "--out", folder / "model", "--cache", folder / "cache"]
        arguments += ["--split", "interleaved", "--epochs", "25", "--alpha", "0.2"]
        with few_left_out():
            result = CliRunner().invoke(app, [str(a) for a in arguments])
        assert result.exit_code == 0, result.output

    root = made_once("trained", train)
    return SmallWorld(small_corridor, root / "cache", root / "model")
