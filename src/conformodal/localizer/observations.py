"""What a reasoner is given, and what it gives: every reasoner is a function from the one to the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from conformodal.core.arrays import BoolArray, FloatArray, IntArray, Rows
from conformodal.geometry import RelativeMotion, Submap

from .candidates import Candidates
from .errors import ReasoningError


@dataclass(frozen=True, eq=False)
class Observations:
    """What is known of the n frames of one recording.

    Attributes
    ----------
    candidates
        One a frame.
    motions
        ``motions[t]`` leads from frame t - 1 to frame t, None where nothing is known of it; the first is ignored.
    timestamps_s
        (n,) seconds, increasing.
    submaps
        Frames numbered 0 to n - 1.
    known
        (n,) whether each image shows a known place; None if all do.

    Raises
    ------
    ReasoningError
        If there are no frames, lengths differ, or timestamps do not increase.
    """

    candidates: Sequence[Candidates]
    motions: Sequence[RelativeMotion | None]
    timestamps_s: FloatArray
    submaps: Sequence[Submap] = ()
    known: BoolArray | None = None

    def __post_init__(self) -> None:
        n = len(self.candidates)
        if n == 0 or not n == len(self.motions) == len(self.timestamps_s):
            raise ReasoningError(
                f"observations need as many candidates as motions and timestamps, at least one: got {n} candidates, "
                f"{len(self.motions)} motions, {len(self.timestamps_s)} timestamps"
            )
        not_later = np.flatnonzero(~(np.diff(self.timestamps_s) > 0))
        if not_later.size:
            t = int(not_later[0])
            raise ReasoningError(f"timestamps must increase: {self.timestamps_s[t : t + 2]} s at frames {t}, {t + 1}")

    def part(self, rows: slice) -> Observations:
        """What is known of consecutive frames, without submaps."""
        known = None if self.known is None else self.known[rows]
        return Observations(self.candidates[rows], self.motions[rows], self.timestamps_s[rows], known=known)

    @property
    def is_known(self) -> BoolArray:
        """(n,) whether each image shows a known place."""
        known = np.ones(len(self.candidates)) if self.known is None else self.known
        return np.asarray(known, dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class PosePath(Rows):
    """One pose a frame, with the spreads of its errors.

    Attributes
    ----------
    timestamps_s : (n,)
    positions_xyz, position_spreads : (n, 3) metres, world
    orientations_quat_wxyz : (n, 4) world from camera
    orientation_spreads_rad : (n,)
    """

    timestamps_s: FloatArray
    positions_xyz: FloatArray
    position_spreads: FloatArray
    orientations_quat_wxyz: FloatArray
    orientation_spreads_rad: FloatArray

    @classmethod
    def choose(
        cls, candidates: Sequence[Candidates], timestamps_s: npt.ArrayLike, chosen: Sequence[int] | IntArray
    ) -> Self:
        """The candidates with these indices, one a frame."""
        chosen_candidates = list(zip(candidates, chosen, strict=True))
        return cls(
            np.asarray(timestamps_s, dtype=np.float64),
            np.array([c.positions_xyz[k] for c, k in chosen_candidates]),
            np.array([c.position_spreads[k] for c, k in chosen_candidates]),
            np.array([c.orientations_quat_wxyz[k] for c, k in chosen_candidates]),
            np.array([c.orientation_spreads_rad[k] for c, k in chosen_candidates]),
        )
