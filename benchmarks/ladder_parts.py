"""Paths of the ladder: from the paper's reasoning to ours, and ours with a part left out, on the same frames."""

from __future__ import annotations

from collections.abc import Sequence as Items
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from common import without_limits, without_rotation
from conformodal.reasoning.bridging import bridge
from conformodal.reasoning.online import online
from conformodal.reasoning.viterbi import viterbi
from ladder_runs import Trained

from conformodal.conformal import SplitConformal
from conformodal.datasets import Sequence
from conformodal.localization.belief import recognised_only
from conformodal.localization.evidence import FrameEvidence
from conformodal.localization.localizer import Localizer
from conformodal.localization.source import PoseSource
from conformodal.model.model import Localization
from conformodal.poses import RelativeMotion, Trajectory, trajectory_errors
from conformodal.reasoning.candidates import Candidates, interval_runs
from conformodal.reasoning.greedy import greedy
from conformodal.reasoning.observations import Observations, PosePath
from conformodal.reasoning.prior import MotionPrior
from conformodal.reasoning.smoother import smooth
from conformodal.running.motions import MotionRecord


@dataclass(frozen=True)
class Parts:
    """What is in. All is ours."""

    neighbours: str = "both"  # "both", "network", "thumbnail" or "none"
    landmarks: bool = True
    submaps: bool = True
    rotations: bool = True
    limits: bool = True
    search: str = "path"  # "path" for Viterbi over the whole path, "lag" for ten frames, or "frame" for each alone
    bridging: bool = True
    smoother: bool = True


ALL = Parts()
BARE = Parts(neighbours="none", landmarks=False, submaps=False, bridging=False, smoother=False)
REMOVED = {
    "neighbours": replace(ALL, neighbours="none"),
    "neighbours by the network's map": replace(ALL, neighbours="thumbnail"),
    "neighbours by global descriptor": replace(ALL, neighbours="network"),
    "landmarks": replace(ALL, landmarks=False),
    "submaps": replace(ALL, submaps=False),
    "relative rotations": replace(ALL, rotations=False),
    "limits on speed and turning": replace(ALL, limits=False),
    "limits and relative rotations": replace(ALL, limits=False, rotations=False),
    "Viterbi (each frame's most probable candidate)": replace(ALL, search="frame"),
    "the frames after the next ten (online search)": replace(ALL, search="lag"),
    "bridging of unknown frames": replace(ALL, bridging=False),
    "smoother": replace(ALL, smoother=False),
}
# Limits and relative rotations, each with and without, on all evidence and on the softmax alone.
SWITCHES = {
    f"{evidence}, {limits}, {motion}": replace(start, limits=limits == "limits", rotations=motion == "rotations")
    for evidence, start in (("all evidence", ALL), ("softmax alone", replace(BARE, smoother=True)))
    for limits in ("limits", "no limits")
    for motion in ("rotations", "no rotations")
}
# From the search on, one part more each.
STEPS = {
    "modes of the softmax, Viterbi over them": replace(BARE, limits=False),
    "limits on speed and turning": BARE,
    "neighbours": replace(BARE, neighbours="both"),
    "landmarks": replace(BARE, neighbours="both", landmarks=True),
    "smoother": replace(BARE, neighbours="both", landmarks=True, smoother=True),
    "submaps": replace(ALL, bridging=False),
    "bridging of unknown frames: ours": ALL,
}


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a place that are answered at some interval, and what is measured of them."""

    sequence: Sequence
    frames: npt.NDArray[np.int64]
    motions: MotionRecord

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

    def __init__(self, trained: Trained, seen: Frames, others: dict[str, PoseSource] | None = None) -> None:
        self.trained, self.seen = trained, seen
        self.features = trained.features[seen.frames]
        self.others = others or {}
        self._kept: dict[tuple[object, ...], Localization] = {}

    def path(self, parts: Parts) -> PosePath:
        """The path with some parts."""
        model, seen = self.trained.model, self.seen
        prior = model.prior if parts.limits else without_limits(model.prior)
        motions = seen.relative if parts.rotations else [without_rotation(m) for m in seen.relative]
        found = self.localization(parts)
        candidates = found.candidates
        if parts.bridging:
            known = found.known if found.known.any() else found.beliefs.recognised
            estimates = found.beliefs.estimates

            def recognised(t: int, here: Candidates) -> Candidates:
                return model.localizer.update(here, [recognised_only(estimates[t])]).candidates

            candidates = bridge(candidates, known, motions, seen.times, model.prior, recognised)
        submaps = seen.motions.submaps_of(seen.frames) if parts.submaps else []
        given = Observations(candidates, motions, seen.times, submaps)
        chosen = self._searched(given, prior, parts.search)
        return smooth(chosen, given, prior) if parts.smoother else chosen

    def localization(self, parts: Parts) -> Localization:
        """What the sources that are in say of each frame."""
        key = (parts.neighbours, parts.landmarks)
        if key not in self._kept:
            model = self.trained.model
            sources = self._sources(parts, model.localizer.sources)
            own = replace(model, localizer=Localizer(sources, model.bins, model.sign_reference))
            self._kept[key] = own.localize(self.evidence)
        return self._kept[key]

    @property
    def evidence(self) -> FrameEvidence:
        """Of all frames."""
        return FrameEvidence(self.features, [self.seen.motions.local_features[i] for i in self.seen.frames.tolist()])

    def greedy(self, rule: SplitConformal | None = None, motions: MotionRecord | None = None) -> PosePath:
        """The paper's reasoning over regions of the softmax alone, by the model's own rule or one over its bins."""
        model, record = self.trained.model, motions or self.seen.motions
        if rule is None:
            found = self.localization(BARE)
            intervals = interval_runs(model.localizer.marginals(found.beliefs), found.regions)
        else:
            proba = model.localizer.beliefs(FrameEvidence(self.features)).proba
            intervals = interval_runs(proba, rule.predict(proba))
        return greedy(intervals, [record.motions[i] for i in self.seen.frames.tolist()], self.seen.times)

    def _searched(self, given: Observations, prior: MotionPrior, how: str) -> PosePath:
        if how != "frame":
            return viterbi(given, prior) if how == "path" else online(given, prior)
        best = [int(np.argmax(c.log_mass)) for c in given.candidates]
        return PosePath.choose(given.candidates, given.timestamps_s, best)

    def _sources(self, parts: Parts, sources: Items[PoseSource]) -> tuple[PoseSource, ...]:
        out = {"neighbours"} if parts.neighbours == "none" else set()
        out |= set() if parts.landmarks else {"landmarks"}
        other = self.others.get(parts.neighbours)
        kept = (other if s.name == "neighbours" and other is not None else s for s in sources if s.name not in out)
        return tuple(kept)
