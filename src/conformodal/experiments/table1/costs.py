"""Costs of a method: trained numbers, and time a frame."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from conformodal.localization import HeadSource
from conformodal.networks import Head
from conformodal.odometry import PoseModel
from conformodal.vision import SoftmaxHead

_Made = TypeVar("_Made")


def timed(make: Callable[[], _Made]) -> tuple[_Made, float]:
    """The result of a function, and the seconds that it took."""
    started = time.perf_counter()
    made = make()
    return made, time.perf_counter() - started


def n_numbers(head: Head | SoftmaxHead) -> int:
    """Trained numbers of a head."""
    if isinstance(head, SoftmaxHead):
        return sum(v.size for k, v in head.weights.items() if k not in head.untrained)
    return sum(p.numel() for p in head.parameters())


def head_of(model: PoseModel) -> SoftmaxHead:
    """The softmax head of a model that has one."""
    source = model.localizer.find(HeadSource)
    assert source is not None
    return source.head


def n_stored(model: PoseModel) -> int:
    """Numbers that the model's sources store."""
    return sum(v.size for source in model.localizer.sources for k, v in source.state().arrays.items() if k != "frames")


def ms_a_frame(answer: Callable[[], object], n_frames: int) -> float:
    """Wall time of the second of two calls, in milliseconds a frame."""
    answer()
    return 1e3 * timed(answer)[1] / n_frames
