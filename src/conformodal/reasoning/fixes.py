"""Pose fixes among candidates: what a frame's landmarks say, weighed against what its softmax says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from conformodal.poses import PoseFix

from .candidates import MAX_CANDIDATES, MIN_MASS, Candidates

FloatArray = npt.NDArray[np.float64]

# Probability that no candidate of the softmax is near the truth; and no fix is right or wrong for sure.
NOWHERE, NEVER_SURE = 0.05, 0.01
# A wrong fix is where things look alike, so at another candidate, with this probability; otherwise it is anywhere.
LOOK_ALIKE = 0.5
_ROTATIONS = 8 * np.pi**2  # volume of all rotations, in units of small rotation vectors


def add_fixes(candidates: Candidates, fixes: Sequence[PoseFix], volume_m3: float) -> Candidates:
    """Candidates of one frame when its fixes are known as well.

    Bayes' rule. Before, the truth lies at a candidate, with its spread, or anywhere; a fix is right, with its spread,
    or it is wrong, and then as likely to be at another candidate as anywhere. After, there are the candidates, if all
    fixes are wrong; each candidate and each fix in one, where they agree; and the fixes, if the softmax is wrong.

    Parameters
    ----------
    candidates
        See :func:`mode_candidates`.
    fixes
        Of the same frame; of several, one at most is right.
    volume_m3
        Of all positions that could be.
    """
    if not fixes:
        return candidates
    none, log_right = odds(fixes)
    own = candidates.log_mass - logsumexp(candidates.log_mass) + np.log1p(-NOWHERE)
    parts = [replace(candidates, log_mass=own + none)]
    for fix, right in zip(fixes, log_right, strict=True):
        both, agree = _fused(candidates, fix)
        # log masses are relative to those of the fix being wrong
        anywhere = -np.log(volume_m3 * _ROTATIONS)
        wrong = np.logaddexp(np.log(LOOK_ALIKE) + logsumexp(own + agree), np.log1p(-LOOK_ALIKE) + anywhere)
        parts.append(replace(both, log_mass=own + agree + right - wrong))
        parts.append(_alone(fix, np.log(NOWHERE) + anywhere + right - wrong))
    return _best(parts)


def odds(fixes: Sequence[PoseFix]) -> tuple[float, FloatArray]:
    """Log probabilities that no fix of a frame is right, and that each is."""
    trust = np.clip([fix.trust for fix in fixes], NEVER_SURE, 1 - NEVER_SURE)
    odds = trust / (1 - trust)
    total = 1 + odds.sum()
    return float(-np.log(total)), np.asarray(np.log(odds / total))


def _fused(old: Candidates, fix: PoseFix) -> tuple[Candidates, FloatArray]:
    """Products of normal densities, and the logarithm of how far they overlap."""
    own, its = old.position_spreads**2, fix.sigma_m**2
    share = its / (own + its)
    off = (old.positions_xyz - fix.position_xyz) ** 2 / (own + its)
    agree = -0.5 * (off + np.log(2 * np.pi * (own + its))).sum(axis=1)
    own_turn, its_turn = old.orientation_spreads_rad**2, fix.sigma_rad**2
    fixed = Rotation.from_quat(fix.orientation_quat_wxyz, scalar_first=True)
    away = (fixed.inv() * Rotation.from_quat(old.orientations_quat_wxyz, scalar_first=True)).as_rotvec()
    turned = fixed * Rotation.from_rotvec((its_turn / (own_turn + its_turn))[:, None] * away)
    agree -= 0.5 * ((away**2).sum(axis=1) / (own_turn + its_turn) + 3 * np.log(2 * np.pi * (own_turn + its_turn)))
    both = replace(
        old,
        positions_xyz=share * old.positions_xyz + (1 - share) * fix.position_xyz,
        position_spreads=np.sqrt(own * share),
        orientations_quat_wxyz=turned.as_quat(scalar_first=True),
        orientation_spreads_rad=np.sqrt(own_turn * its_turn / (own_turn + its_turn)),
    )
    return both, agree


def _alone(fix: PoseFix, log_mass: float) -> Candidates:
    return Candidates(
        fix.position_xyz[None],
        np.full((1, 3), fix.sigma_m),
        fix.orientation_quat_wxyz[None],
        np.array([fix.sigma_rad]),
        np.array([log_mass]),
    )


def _best(parts: Sequence[Candidates]) -> Candidates:
    """The most probable of all, most probable first, with masses that sum to one before the others are dropped."""
    joined = Candidates(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Candidates)))
    log_mass = joined.log_mass - logsumexp(joined.log_mass)
    order = np.argsort(-log_mass, kind="stable")[:MAX_CANDIDATES]
    order = order[log_mass[order] >= min(np.log(MIN_MASS), log_mass[order[0]])]
    kept = Candidates(*(getattr(joined, f.name)[order] for f in fields(Candidates)))
    return replace(kept, log_mass=log_mass[order])
