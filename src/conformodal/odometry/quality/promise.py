"""What calibration can promise with a given number of frames or stretches, by kind of evidence."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import ceil

import numpy as np

from conformodal.conformal import SplitConformal
from conformodal.conformal.diagnostics import coverage_band
from conformodal.datasets import SplitKind

from ..model import PoseModel
from ..region_rules import EvidenceKind

N_NEW = 1000
_DIGITS = 10_000


@dataclass(frozen=True)
class KindPromise:
    """What the regions of one kind of evidence can promise.

    Attributes
    ----------
    evidence
        The kind.
    alpha
        The rate that the model promises.
    n_frames, n_units
        Frames that calibrate it; and what is exchangeable: these frames, or the stretches or recordings they are of.
    finite
        Whether its regions are bounded at `alpha`.
    n_needed
        Units that `alpha` needs at least.
    least_alpha
        The least rate with bounded regions, exact; 1 where there is none.
    band
        Central 99 % interval of the coverage of new frames, over all calibrations and frames; None where no law is
        exact.
    """

    evidence: EvidenceKind
    alpha: float
    n_frames: int
    n_units: int
    finite: bool
    n_needed: int
    least_alpha: Fraction
    band: tuple[float, float] | None

    @property
    def least_alpha_shown(self) -> float:
        """The least rate, rounded up to four digits, so that it can be asked for."""
        return ceil(self.least_alpha * _DIGITS) / _DIGITS


def promises(model: PoseModel) -> list[KindPromise]:
    """What a model can promise, one for each kind of evidence that has regions of its own."""
    exchangeable = model.split.kind is SplitKind.INTERLEAVED
    found = []
    for kind, rule in model.rules.of.items():
        law = exchangeable and rule.groups_ is None and rule.joint != "bonferroni" and len(rule.scores_) > 0
        band = coverage_band(rule.n_units, N_NEW, rule.alpha_per_target) if law else None
        finite = bool(np.isfinite(rule.thresholds_).all())
        n, needed = len(rule.scores_), ceil(1 / rule.alpha_per_target) - 1
        found.append(KindPromise(kind, float(rule.alpha), n, rule.n_units, finite, needed, least_alpha(rule), band))
    return found


def least_alpha(rule: SplitConformal) -> Fraction:
    """The least miscoverage rate at which a rule has a finite threshold for every target; 1 where none has.

    The threshold is the score at which the weights of the calibration members reach ``1 - alpha`` of their sum and one
    more whole unit; scores that are infinite do not count.
    """
    scores = rule.scores_
    if len(scores) == 0:
        return Fraction(1)
    if rule.groups_ is None:
        weights = [Fraction(1)] * len(scores)
    else:
        _, group, counts = np.unique(rule.groups_, return_inverse=True, return_counts=True)
        sizes = counts[group] if rule.group_sizes_ is None else rule.group_sizes_
        weights = [Fraction(1, int(size)) for size in sizes]
    total = sum(weights, Fraction(1))
    worst = Fraction(0)
    for column in rule.rule.columns(scores).T:
        reached = sum((w for w, score in zip(weights, column, strict=True) if np.isfinite(score)), Fraction(0))
        worst = max(worst, (total - reached) / total)
    share = rule.bins.n_targets if rule.joint == "bonferroni" else 1
    return min(worst * share, Fraction(1))
