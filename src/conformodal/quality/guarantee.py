"""What calibration can guarantee with a given number of frames or stretches, by evidence type."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import ceil

import numpy as np

from conformodal.conformal import SplitConformal, coverage_band
from conformodal.localizer.region_rules import EvidenceType
from conformodal.pipeline.model import PoseModel

N_NEW = 1000
_DIGITS = 10_000


@dataclass(frozen=True)
class EvidenceGuarantee:
    """What the regions of one evidence type can guarantee."""

    evidence: EvidenceType
    alpha: float  # the miscoverage rate in force
    n_frames: int  # of this type that calibrate
    n_units: int  # exchangeable units: these frames, or the stretches or recordings that they belong to
    weight: float  # what they weigh, in whole units: fewer than `n_units` where types share stretches
    finite: bool  # whether its regions are bounded at `alpha`
    weight_needed: float  # the weight from which on a threshold at `alpha` is finite
    # units like those that calibrate which bounded regions at `alpha` need; None where no number of them would do,
    # because too many frames lie beyond the training range
    n_needed: int | None
    least_alpha: Fraction  # the least rate from which on regions are bounded, exact; 1 where there is none
    # central 99 % interval of the coverage of new frames, over all calibrations and frames; None where no law is exact
    band: tuple[float, float] | None

    @property
    def by_frame(self) -> bool:
        """Whether frames are exchangeable, not stretches or recordings."""
        return self.weight == self.n_frames

    @property
    def least_alpha_shown(self) -> float:
        """The least rate, rounded up to four digits, so that it can be asked for."""
        return ceil(self.least_alpha * _DIGITS) / _DIGITS


def guarantees(model: PoseModel) -> list[EvidenceGuarantee]:
    """What a model can guarantee, one for each evidence type that has regions of its own."""
    exchangeable = model.frames_are_exchangeable
    rules, found = model.rules, []
    for kind, rule in rules.by_type.items():
        exact = exchangeable and rule.groups_ is None and rule.joint != "bonferroni"
        band = coverage_band(rule.n_units, N_NEW, rule.alpha_per_target) if exact and len(rule.scores_) else None
        found.append(
            EvidenceGuarantee(
                evidence=kind,
                alpha=float(rule.alpha),
                n_frames=len(rule.scores_),
                n_units=rule.n_units,
                weight=float(rule.weight),
                finite=bool(np.isfinite(rule.thresholds_).all()),
                weight_needed=float(1 / rule.alpha_per_target - 1),
                n_needed=_units_needed(rule, rules.overall.n_units),
                least_alpha=least_alpha(rule),
                band=band,
            )
        )
    return found


def _units_needed(rule: SplitConformal, n_units: int) -> int | None:
    """Units like the `n_units` that a rule is calibrated on for finite thresholds; None where no number would do."""
    rate = rule.alpha_per_target
    if rule.groups_ is None:
        n_units = len(rule.scores_)
    # n times as many calibrate with finite thresholds if alpha (n weight + 1) is at least n infinite + 1
    room = rate * rule.weight - _infinite(rule)
    return ceil(n_units * (1 - rate) / room) if room > 0 else None


def _infinite(rule: SplitConformal) -> Fraction:
    """What the calibration members with an infinite score weigh, in the target that has most."""
    worst = Fraction(0)
    for column in rule.rule.columns(rule.scores_).T:
        lost = (w for w, score in zip(rule.weights, column, strict=True) if not np.isfinite(score))
        worst = max(worst, sum(lost, Fraction(0)))
    return worst


def least_alpha(rule: SplitConformal) -> Fraction:
    """The least miscoverage rate at which a rule has a finite threshold for every target; 1 where none has.

    The threshold is the score at which the weights of the calibration members reach ``1 - alpha`` of their sum and one
    more whole unit; scores that are infinite do not count.
    """
    if not len(rule.scores_):
        return Fraction(1)
    share = rule.bins.n_targets if rule.joint == "bonferroni" else 1
    return min(share * (1 + _infinite(rule)) / (1 + rule.weight), Fraction(1))
