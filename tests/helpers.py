"""What tests share: a command run in this process, what a folder holds, missing values, and quicker maps."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from conformodal.conformal import Regions
from conformodal.localizer.landmark_settings import LandmarkSettings
from conformodal.localizer.mixtures import PoseMixture
from conformodal.localizer.regions import EvidenceType, PoseRegions, Support
from conformodal.pipeline.config import ModelConfig
from conformodal.pipeline.results import record_of

LFS_POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"ab" * 32 + b"\nsize 12345\n"


def invoke(*arguments):
    from typer.testing import CliRunner  # not before a test of the command line runs

    from conformodal.cli.main import app

    return CliRunner().invoke(app, [str(a) for a in arguments])


def run_ok(*arguments):
    """The result of a command that comes to its end."""
    result = invoke(*arguments)
    assert result.exit_code == 0, result.output
    return result


def refusal(*arguments):
    """What a command says that refuses its arguments, on one line."""
    result = invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    return " ".join(result.stderr.split())


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def fill(folder: Path, files) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


def region_record(name, timestamp_s, intervals, known_p=None, evidence=EvidenceType.GLOBAL):
    """The record of a frame with these intervals (m, 2) per target, whose region is their product."""
    region = SimpleNamespace(intervals=lambda _: intervals, product=True)
    estimate = SimpleNamespace(
        timestamp_s=timestamp_s, relative_motion=None, region=region, known_p=known_p, evidence=evidence,
        reliable=True, places=[], path_region=None, localization=None,
    )  # fmt: skip
    return record_of(name, estimate)


class Missing:
    """Stands for ``pandas.NA``: compares to nothing, and is no truth value."""

    def __ne__(self, other):
        return self

    __eq__ = __ne__
    __hash__ = object.__hash__

    def __bool__(self):
        raise TypeError("boolean value of NA is ambiguous")


def pose_regions_of(bins, masks, unbounded, candidates=None):
    """Regions of poses from sets by hand: their product, or what an image's candidates support of it."""
    nothing = PoseMixture.weighted(np.zeros((1, 3)), np.ones((1, 3)), np.eye(4)[:1], np.ones(1), np.zeros(1))
    its = [nothing] * len(unbounded) if candidates is None else candidates
    supports = [Support.of(one, bins, np.eye(4)[0]) for one in its]
    sets = Regions(bins, masks, unbounded)
    return PoseRegions(sets, supports, np.ones(len(its)), product=candidates is None)


@contextmanager
def few_left_out() -> Iterator[None]:
    """Maps learn their errors from 25 keyframes, not 100, in two thirds of the time: for what asks no exact errors."""
    usual = ModelConfig.for_sources.fget
    few = property(lambda config: replace(usual(config), landmarks=LandmarkSettings(n_left_out=25)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ModelConfig, "for_sources", few)
        yield
