"""Paths of the ladder: from the paper's reasoning to ours, and ours with a part left out, on the same frames."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
from common import without_limits, without_parts
from ladder_runs import Trained

from conformodal.conformal import SplitConformal
from conformodal.datasets import Sequence
from conformodal.odometry import Fixes, MotionRecord, PoseModel
from conformodal.odometry.region_rules import trusted, trusted_only
from conformodal.poses import RelativeMotion, Trajectory, trajectory_errors
from conformodal.reasoning import (
    Candidates,
    MotionPrior,
    Observations,
    PosePath,
    bridge,
    fit_spread_scale,
    greedy,
    interval_means,
    mode_candidates,
    online,
    smooth,
    viterbi,
)


@dataclass(frozen=True)
class Parts:
    """What is in. All is ours."""

    members: str = "all"  # of the ensemble: "all", "one", or "region" for the head that calibration frames are new to
    neighbours: str = "both"  # "both", "network", "thumbnail" or "none"
    landmarks: bool = True
    submaps: bool = True
    rotations: bool = True
    directions: bool = True
    limits: bool = True
    search: str = "path"  # "path" for Viterbi over the whole path, "lag" for ten frames, or "frame" for each alone
    near_peaks: bool = True
    vague: bool = True
    scale: bool = True
    bridging: bool = True
    smoother: bool = True


ALL = Parts()
BARE = Parts(members="region", neighbours="none", landmarks=False, submaps=False, bridging=False, smoother=False)
REMOVED = {
    "two of the three ensemble members": replace(ALL, members="one"),
    "members that know the calibration frames": replace(ALL, members="region"),
    "neighbours": replace(ALL, neighbours="none"),
    "neighbours by the network's map": replace(ALL, neighbours="thumbnail"),
    "neighbours by thumbnail": replace(ALL, neighbours="network"),
    "landmarks": replace(ALL, landmarks=False),
    "submaps": replace(ALL, submaps=False),
    "relative rotations": replace(ALL, rotations=False),
    "relative directions": replace(ALL, directions=False),
    "relative motion": replace(ALL, rotations=False, directions=False),
    "limits on speed and turning": replace(ALL, limits=False),
    "limits and relative motion": replace(ALL, limits=False, rotations=False, directions=False),
    "Viterbi (each frame's most probable candidate)": replace(ALL, search="frame"),
    "the frames after the next ten (online search)": replace(ALL, search="lag"),
    "near peaks as one mode": replace(ALL, near_peaks=False),
    "vague candidates reached, not centred": replace(ALL, vague=False),
    "spreads of the size of errors": replace(ALL, scale=False),
    "bridging of unknown frames": replace(ALL, bridging=False),
    "smoother": replace(ALL, smoother=False),
}
# Limits and relative motion, each with and without, on all evidence and on the softmax alone.
SWITCHES = {
    f"{evidence}, {limits}, {motion}": replace(
        start, limits=limits == "limits", rotations=motion == "motion", directions=motion == "motion"
    )
    for evidence, start in (("all evidence", ALL), ("softmax alone", replace(BARE, smoother=True)))
    for limits in ("limits", "no limits")
    for motion in ("motion", "no motion")
}
# From the search on, one part more each.
STEPS = {
    "modes of the softmax, Viterbi over them": replace(BARE, limits=False),
    "limits on speed and turning": BARE,
    "ensemble of three that knows the calibration frames": replace(BARE, members="all"),
    "neighbours": replace(BARE, members="all", neighbours="both"),
    "landmarks": replace(BARE, members="all", neighbours="both", landmarks=True),
    "smoother": replace(BARE, members="all", neighbours="both", landmarks=True, smoother=True),
    "submaps": replace(ALL, bridging=False),
    "bridging of unknown frames: ours": ALL,
}


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a place that are answered at some interval, and what is measured of them."""

    sequence: Sequence
    frames: npt.NDArray[np.int64]
    motions: MotionRecord
    fixes: list[Fixes]
    known_p: npt.NDArray[np.float64]

    @property
    def times(self) -> npt.NDArray[np.float64]:
        """Seconds."""
        return self.sequence.timestamps_s[self.frames]

    @property
    def truth(self) -> Trajectory:
        """Poses."""
        return self.sequence.require_truth()[self.frames]

    @property
    def relative(self) -> list[RelativeMotion | None]:
        """Motions from frame to frame."""
        return [self.motions.motions[i] for i in self.frames.tolist()]

    def error(self, path: PosePath | Trajectory) -> list[float]:
        """RMSE in metres and degrees."""
        off = trajectory_errors(Trajectory(self.times, path.positions_xyz, path.orientations_quat_wxyz), self.truth)
        return [off["rmse_m"], off["rmse_deg"]]


def spaced(times: npt.NDArray[np.float64], frames: npt.NDArray[np.int64], interval_s: float) -> npt.NDArray[np.int64]:
    """Of some frames those that follow each other after an interval or more."""
    kept = [int(frames[0])]
    for i in frames[1:].tolist():
        if times[i] >= times[kept[-1]] + interval_s - 1e-6:
            kept.append(i)
    return np.array(kept)


class Paths:
    """Paths of a trained model over some frames, with the parts that are asked for."""

    def __init__(self, trained: Trained, seen: Frames, others: dict[str, PoseModel] | None = None) -> None:
        self.trained, self.seen = trained, seen
        self.features = trained.features[seen.frames]
        self.others = others or {}
        self._kept: dict[tuple[object, ...], list[Candidates]] = {}

    def path(self, parts: Parts) -> PosePath:
        """The path with some parts."""
        model, seen = self.trained.model, self.seen
        prior = model.prior if parts.limits else without_limits(model.prior)
        motions = [without_parts(m, rotation=parts.rotations, direction=parts.directions) for m in seen.relative]
        candidates = self._candidates(parts)
        known = seen.known_p > model.rules.level
        if parts.bridging:
            fixes = seen.fixes if parts.landmarks else [Fixes() for _ in seen.fixes]
            if not known.any():
                known = trusted([its.search for its in fixes])
            candidates = bridge(
                candidates,
                known,
                motions,
                seen.times,
                model.prior,
                lambda t, here: model.with_fixes(here, trusted_only(fixes[t].search)),
            )
        submaps = []
        if parts.submaps:
            places = {frame: k for k, frame in enumerate(seen.frames.tolist())}
            submaps = [s for submap in seen.motions.submaps if (s := submap.renumbered(places)) is not None]
        given = Observations(candidates, motions, seen.times, submaps)
        with _survivors(keep=parts.vague):
            chosen = self._searched(given, prior, parts.search)
        return smooth(chosen, given, prior) if parts.smoother else chosen

    def _searched(self, given: Observations, prior: MotionPrior, how: str) -> PosePath:
        if how != "frame":
            return viterbi(given, prior) if how == "path" else online(given, prior)
        best = [int(np.argmax(c.log_mass)) for c in given.candidates]
        return PosePath.choose(given.candidates, given.timestamps_s, best)

    def greedy(self, rule: SplitConformal | None = None, motions: MotionRecord | None = None) -> PosePath:
        """The paper's reasoning over regions of the softmax alone, by the model's own rule or another."""
        model, record = self.trained.model, motions or self.seen.motions
        proba = model.proba(self.features)
        intervals = interval_means(proba, (rule or model.rules.softmax).predict(proba))
        return greedy(intervals, [record.motions[i] for i in self.seen.frames.tolist()], self.seen.times)

    def _candidates(self, parts: Parts) -> list[Candidates]:
        key = (parts.members, parts.neighbours, parts.landmarks, parts.near_peaks, parts.scale)
        if key not in self._kept:
            model = self._model(parts)
            search = model.search(self.features)
            bins = {} if parts.near_peaks else {"mode_bins": 0}
            scale = model.scale if parts.scale else None
            found = mode_candidates(
                search.proba, model.bins, scale=scale, strangeness=search.strangeness if parts.scale else None, **bins
            )
            found = [model.with_fixes(here, its) for here, its in zip(found, search.fixes, strict=True)]
            if parts.landmarks:
                found = [model.with_fixes(c, f.search) for c, f in zip(found, self.seen.fixes, strict=True)]
            self._kept[key] = found
        return self._kept[key]

    def _model(self, parts: Parts) -> PoseModel:
        model = self.trained.model
        if parts.neighbours in self.others:
            model = replace(model, local=self.others[parts.neighbours].local)
        members = {"all": model.finders, "one": model.finders[:1], "region": (model.head,)}[parts.members]
        model = replace(model, finders=members)
        if parts.neighbours != "none" or model.local is None:
            return model
        held_out = model.split.calibration  # new to the head of the region
        modes = mode_candidates(model.proba(self.trained.features[held_out]), model.bins)
        truth = self.seen.sequence.require_truth()[held_out]
        return replace(model, local=None, scale=fit_spread_scale(modes, truth))


@contextmanager
def _survivors(*, keep: bool) -> Iterator[None]:
    """Without: a vague candidate is reached from and left at its mean, wherever the path came from."""
    if keep:
        yield
        return
    with ExitStack() as stack:
        for name in ("viterbi", "online"):
            module = importlib.import_module(f"conformodal.reasoning.{name}")
            stack.enter_context(patch.object(module, "survivors", lambda start, after, *_: after))
        yield
