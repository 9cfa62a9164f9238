"""A short stretch of a camera's path as its images alone tell it: everything but its length."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from conformodal.core.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Submap:
    """Poses of a few frames relative to the first of them, its anchor, up to one unknown length: the submap's unit.

    Attributes
    ----------
    frames
        (k,) increasing numbers of the frames; the anchor first.
    R_anchor_frame
        (k, 3, 3): takes directions from each camera's frame to the anchor's; the first is the identity.
    positions
        (k, 3) camera centres in the anchor's camera frame; the first is zero.
    depth
        Median depth of the corners, seen from the anchor.
    sigma
        Spread of the errors of `positions`, per axis.
    rotation_sigma_rad
        Spread of the errors of `R_anchor_frame`, about each axis.
    """

    frames: IntArray
    R_anchor_frame: FloatArray
    positions: FloatArray
    depth: float
    sigma: float
    rotation_sigma_rad: float

    def renumbered(self, number: Mapping[int, int]) -> Self | None:
        """With the frames' numbers replaced; None where one has no other."""
        frames = [number.get(f) for f in self.frames.tolist()]
        return None if None in frames else replace(self, frames=np.array(frames, dtype=np.int64))

    @property
    def span(self) -> int:
        """Frames from the anchor to the last, those between that are not part of it counted in."""
        return int(self.frames[-1] - self.frames[0]) + 1
