"""Shared fixtures: where real data lies, and one small model on one small corridor for all tests that need one."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What needs the small model waits for its training."""
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


@dataclass(frozen=True)
class SmallWorld:
    folder: Path
    cache: Path
    model: Path


@pytest.fixture(scope="session")
def small_corridor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A corridor of three modules flown once."""
    from conformodal.corridor import write_corridor

    folder = tmp_path_factory.mktemp("small") / "corridor"
    write_corridor(folder, n_modules=3, n_laps=1, seed=3)
    return folder


@pytest.fixture(scope="session")
def small_world(small_corridor: Path) -> SmallWorld:
    """The small corridor and a model trained on it through the command line."""
    from typer.testing import CliRunner

    from conformodal.cli.main import app

    root = small_corridor.parent
    arguments = ["train", small_corridor, "--out", root / "model", "--cache", root / "cache"]
    result = CliRunner().invoke(
        app, [str(a) for a in arguments] + ["--split", "interleaved", "--epochs", "25", "--alpha", "0.2"]
    )
    assert result.exit_code == 0, result.output
    return SmallWorld(small_corridor, root / "cache", root / "model")
