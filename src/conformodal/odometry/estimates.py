"""What is found out about one frame of a stream, and about all frames of a sequence."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import Regions
from conformodal.motion import Corners
from conformodal.poses import PoseFix, RelativeMotion, Submap, Trajectory
from conformodal.reasoning import Candidates, Observations

from .answers import METHODS
from .landmarks import Fixes
from .model import Search
from .region_rules import Evidence

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Answer to one frame of a stream.

    Attributes
    ----------
    timestamp_s
        Seconds.
    pose
        The candidate that the motion so far speaks for, as a trajectory of one, or None without an image. A point
        estimate: the guarantee is the region's.
    revised
        The best path through the last frames, oldest first, this one last; or None without an image. What was said of
        a frame may change until `lag` frames have followed it.
    region
        Calibrated region of this frame alone (length 1), or None without an image. Where landmarks were looked for, it
        rests on them too, and is smaller.
    candidates
        Candidate poses, or None without an image.
    relative_motion
        Motion since the last usable frame, or None.
    tracks
        Corners of the last usable frame and the same ones here, (m, 2) pixels each, or None.
    corners
        All corners here, or None without an image.
    fixes
        Where landmarks have this frame, place by place; empty where none were recognised or looked for.
    known_p
        Conformal p-value of "this image shows a place that is known"; None without an image, and where images are not
        tested. The region is the whole space where it is small.
    evidence
        What the region rests on; None without an image.
    position_spread_m, orientation_spread_rad
        How far off the pose may be, by its own account: spreads of the path's errors; None without an image. They grow
        while the path is bridged by motion alone.
    features
        (F,) of the image, or None without one.
    proba, search
        Calibrated head's softmaxes, seven arrays (1, K_j), and what the search starts from; None without an image.
    reliable
        False where image or motion could not be used, or the image shows no place that is known; `problem` says why.
    """

    timestamp_s: float
    pose: Trajectory | None
    revised: Trajectory | None
    region: Regions | None
    candidates: Candidates | None
    relative_motion: RelativeMotion | None
    reliable: bool
    problem: str = ""
    features: npt.NDArray[np.float32] | None = None
    proba: list[npt.NDArray[Any]] | None = None
    search: Search | None = None
    tracks: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None = None
    corners: Corners | None = None
    fixes: list[PoseFix] = field(default_factory=list)
    known_p: float | None = None
    evidence: Evidence | None = None
    position_spread_m: float | None = None
    orientation_spread_rad: float | None = None


@dataclass(eq=False)
class OdometryRun:
    """Everything found out about the frames of a sequence.

    Attributes
    ----------
    frames
        (m,) indices into the sequence that were answered.
    timestamps_s
        (m,) seconds.
    regions, candidates, motions
        One a frame; ``motions[t]`` leads from the frame before.
    submaps
        Of these frames, by their place in `frames`.
    fixes
        Where each frame could be by its landmarks; one :class:`Fixes` a frame.
    trajectories
        By method, see :data:`METHODS`.
    answer
        Which of them is the answer.
    unreadable
        Frames that could not be decoded, and why.
    known_p, kinds
        (m,) p-values of showing a known place, NaN where images are not tested, and what each region rests on
        (:class:`Evidence`).
    """

    frames: IntArray
    timestamps_s: npt.NDArray[np.float64]
    regions: Regions
    candidates: list[Candidates]
    motions: list[RelativeMotion | None]
    submaps: list[Submap]
    fixes: list[Fixes]
    trajectories: dict[str, Trajectory]
    unreadable: dict[int, str] = field(default_factory=dict)
    known_p: npt.NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    kinds: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    answer: str = METHODS[0]

    @property
    def trajectory(self) -> Trajectory:
        """The answer."""
        return self.trajectories[self.answer]

    @property
    def reliable(self) -> npt.NDArray[np.bool_]:
        """(m,) whether a known place is shown and motion since the frame before could be used, if there is one."""
        moving = np.array([m is None or m.reliable for m in self.motions], dtype=np.bool_)
        return np.asarray(moving & (self.kinds != Evidence.UNKNOWN))

    def observations(self, at: IntArray) -> Observations:
        """What reasoning is given about the frames of one recording, by their places (m,) in `frames`."""
        places = {place: k for k, place in enumerate(at.tolist())}
        submaps = [s for submap in self.submaps if (s := submap.renumbered(places)) is not None]
        motions = [self.motions[t] for t in at]
        return Observations([self.candidates[t] for t in at], motions, self.timestamps_s[at], submaps)
