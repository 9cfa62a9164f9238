"""What the calibration of a model guarantees, by evidence type."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from conformodal.conformal import coverage_band
from conformodal.core.words import counted
from conformodal.localizer.regions import EvidenceType
from conformodal.pipeline.model import PoseModel

N_NEW = 1000
WHERE = {
    EvidenceType.GLOBAL: "in all images",
    EvidenceType.UNMATCHED: "where landmarks recognise no place",
    EvidenceType.LANDMARKS: "where landmarks recognise the place",
    EvidenceType.DISTURBED: "in disturbed images",
}


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

    @property
    def beyond_range(self) -> bool:
        """Whether regions are unbounded because calibration frames lie beyond the training range, not too few."""
        return not self.finite and self.weight >= self.weight_needed

    def describe(self) -> str:
        """The guarantee in one line."""
        text = f"regions {WHERE[self.evidence]}: {'bounded' if self.finite else 'unbounded'} at alpha = {self.alpha:g}"
        text += f", calibrated on {counted(self.n_frames, 'frame')}"
        if self.weight != self.n_frames:
            text += f" (weight {self.weight:.1f} of {self.n_units}, at least {self.weight_needed:g} needed)"
        if self.band is not None and self.finite:
            text += f"; cover {self.band[0]:.3f} to {self.band[1]:.3f} of {N_NEW} new frames (99 % band)"
        return text

    def advice(self) -> str:
        """What to record so that regions are bounded."""
        what = "training data that reach further" if self.beyond_range else "more, or ask for a larger alpha"
        return f"Record {what}: regions are unbounded {WHERE[self.evidence]}."


def guarantees(model: PoseModel) -> list[EvidenceGuarantee]:
    """The guarantees of a model, one for each evidence type that has regions of its own."""
    listed = []
    for evidence, rule in model.rules.by_type.items():
        exact = model.frames_are_exchangeable and rule.units_ is None and rule.joint != "bonferroni"
        has_band = exact and len(rule.scores_) > 0
        listed.append(
            EvidenceGuarantee(
                evidence=evidence,
                alpha=float(rule.alpha),
                n_frames=len(rule.scores_),
                n_units=rule.n_units,
                weight=float(rule.weight),
                weight_needed=float(1 / rule.alpha_per_target - 1),
                finite=bool(np.isfinite(rule.thresholds_).all()),
                band=coverage_band(rule.n_units, N_NEW, rule.alpha_per_target) if has_band else None,
            )
        )
    return listed
