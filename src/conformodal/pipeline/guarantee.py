"""What a model's regions guarantee, and under which condition, in words and numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.conformal import coverage_band
from conformodal.core.words import counted
from conformodal.io import SplitKind
from conformodal.localizer.regions import EvidenceType

from .model import PoseModel

N_NEW = 1000
_IN_ROOMS = (
    " Each room has thresholds of its own: so it holds in each room with enough calibration frames, and in the small "
    "rooms together if these have enough; else it is approximate in small rooms."
)
_NOT_ELSEWHERE = "; nothing is guaranteed for another recording"
WHERE = {
    EvidenceType.GLOBAL: "in all images",
    EvidenceType.UNMATCHED: "where landmarks recognise no place",
    EvidenceType.LANDMARKS: "where landmarks recognise the place",
    EvidenceType.DISTURBED: "in disturbed images",
}


def describe_guarantee(model: PoseModel) -> str:
    """What the model's regions guarantee, under which condition, and where that is known not to hold."""
    return f"{_of_all_rooms(model)}{'' if model.rules.rooms is None else _IN_ROOMS}"


def _of_all_rooms(model: PoseModel) -> str:
    rule, comparison = model.calibration, model.comparison
    what = "each target by itself" if rule.joint == "none" else "the whole pose"
    text = f"Guarantee: regions hold {what} with probability at least {1 - model.alpha:g} in "
    if rule.units_ is None:
        text += f"a frame exchangeable with the {model.n_calibration} that calibrate them, "
        if model.frames_are_exchangeable:
            return f"{text}as one drawn at random together with these. It does not reach another recording."
        return f"{text}which frames of another stretch or recording, such as the test frames, are not."
    unit = "recording" if model.configuration.get("whole_recordings") else "stretch"
    text += (
        f"a random frame of a new {unit}, if it is exchangeable with the {rule.n_units} that calibrate them, and the "
        "model's sources, which know all of these, have no larger scores than those that lacked some."
    )
    if n_judged := len(model.journal_with_poses):
        text += (
            f" {counted(n_judged, 'recording')} joined after training, each judged by the smaller map before "
            "it: this holds if they are exchangeable in the order in which they came, and more map helps."
        )
    if n_unposed := len(model.journal) - n_judged:
        text += (
            f" {counted(n_unposed, 'recording')} without poses joined the map where the model's own answers put them, "
            "and calibrate nothing: this holds if they made no scores larger."
        )
    if unit == "stretch":
        text += " It does not reach a recording of which nothing is known."
    if model.split.kind is SplitKind.GIVEN:
        text += " It does not reach the test frames, which were not drawn at random: the data set names them."
    if comparison is not None:
        text += f" {comparison.describe()}."
    if comparison is not None and comparison.overconfident:
        text += " So the guarantee does not hold: calibrate on recordings (more of them) or with --calibration frames."
    return text


def short_guarantee(model: PoseModel) -> str:
    """What the model's regions guarantee, in half a sentence; or why they do not."""
    rule, comparison, asked = model.calibration, model.comparison, f"{100 * (1 - model.alpha):g} %"
    if comparison is not None and comparison.overconfident:
        share = 100 * comparison.covered[0]
        return (
            f"no guarantee of the {asked} asked for: regions hold the pose in {share:.0f} % of "
            f"{counted(comparison.n_frames, 'held-out frame')}, fewer than those of the sources that calibrate"
        )
    what = f"guaranteed{' for each of its numbers alone' if rule.joint == 'none' else ''} in {asked} of "
    if rule.units_ is not None:
        if model.configuration.get("whole_recordings"):
            return f"{what}the frames of a new recording, on average over these"
        of = "one of these recordings" if model.journal_with_poses else "the same recording"
        return f"{what}the frames of a new stretch of {of}, on average over these{_NOT_ELSEWHERE}"
    if model.frames_are_exchangeable:
        return f"{what}frames drawn at random from the same recording{_NOT_ELSEWHERE}"
    return f"no guarantee of the {asked} asked for: random frames calibrate, and held-out stretches are unlike these"


@dataclass(frozen=True)
class EvidenceGuarantee:
    """What the regions of one evidence type guarantee."""

    evidence: EvidenceType
    alpha: float  # the miscoverage rate in force
    n_frames: int  # of this type that calibrate
    n_units: int  # exchangeable units: these frames, or the stretches or recordings that they belong to
    weight: float  # of these frames, in whole units: fewer than `n_units` where types share stretches
    weight_needed: float  # for a finite threshold at `alpha`
    finite: bool  # whether its regions are bounded at `alpha`
    # central 99 % interval of the coverage of new frames, over all calibrations and frames; None where no law is exact
    band: tuple[float, float] | None

    def describe(self) -> str:
        """The guarantee in one line."""
        text = f"regions {WHERE[self.evidence]}: {'bounded' if self.finite else 'unbounded'} at alpha = {self.alpha:g}"
        text += f", calibrated on {counted(self.n_frames, 'frame')}"
        if self.weight != self.n_frames:
            text += f" (weight {self.weight:.1f} of {self.n_units}, at least {self.weight_needed:g} needed)"
        if self.band is not None and self.finite:
            text += f"; cover {self.band[0]:.3f} to {self.band[1]:.3f} of {N_NEW} new frames (99 % band)"
        return text


def guarantees(model: PoseModel) -> list[EvidenceGuarantee]:
    """The guarantees of a model, one for each evidence type that has regions of its own."""
    listed = []
    for evidence, rule in model.rules.by_type.items():
        # with several rooms, each has a law of its own
        exact = model.frames_are_exchangeable and rule.units_ is None and model.rules.rooms is None
        listed.append(
            EvidenceGuarantee(
                evidence=evidence,
                alpha=float(rule.alpha),
                n_frames=len(rule.scores_),
                n_units=rule.n_units,
                weight=float(rule.weight),
                weight_needed=float(1 / rule.alpha_per_target - 1),
                finite=bool(np.isfinite(rule.thresholds_).all()),
                band=coverage_band(rule.n_units, N_NEW, rule.alpha_per_target) if exact and rule.n_units else None,
            )
        )
    return listed
