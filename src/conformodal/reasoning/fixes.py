"""Pose fixes among candidates: what a frame's landmarks say, weighed against what its softmax says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

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
    old = candidates
    position_mass = old.position_log_mass - logsumexp(old.position_log_mass) + np.log1p(-NOWHERE)
    turn_mass = old.orientation_log_mass - logsumexp(old.orientation_log_mass) + np.log1p(-NOWHERE)
    positions, spreads, masses = [old.positions_xyz], [old.position_spreads], [position_mass + none]
    quats, turns, turn_masses = [old.orientations_quat_wxyz], [old.orientation_spreads_rad], [turn_mass + none]
    for fix, right in zip(fixes, log_right, strict=True):
        both, spread, agree = _fused_positions(old, fix)
        positions += [both, fix.position_xyz[None]]
        spreads += [spread, np.full((1, 3), fix.sigma_m)]
        masses += _masses(position_mass, agree, right, volume_m3)
        turned, turn, agree = _fused_orientations(old, fix)
        quats += [turned, fix.orientation_quat_wxyz[None]]
        turns += [turn, np.array([fix.sigma_rad])]
        turn_masses += _masses(turn_mass, agree, right, _ROTATIONS)
    first, mass = _best(np.concatenate(masses))
    second, turn_mass = _best(np.concatenate(turn_masses))
    return replace(
        old,
        positions_xyz=np.concatenate(positions)[first],
        position_spreads=np.concatenate(spreads)[first],
        position_log_mass=mass,
        orientations_quat_wxyz=np.concatenate(quats)[second],
        orientation_spreads_rad=np.concatenate(turns)[second],
        orientation_log_mass=turn_mass,
    )


def odds(fixes: Sequence[PoseFix]) -> tuple[float, FloatArray]:
    """Log probabilities that no fix of a frame is right, and that each is."""
    trust = np.clip([fix.trust for fix in fixes], NEVER_SURE, 1 - NEVER_SURE)
    odds = trust / (1 - trust)
    total = 1 + odds.sum()
    return float(-np.log(total)), np.asarray(np.log(odds / total))


def _masses(own: FloatArray, agree: FloatArray, right: float, volume: float) -> list[FloatArray]:
    """Log masses of each candidate with a fix, and of the fix alone, relative to those of the fix being wrong."""
    anywhere = -np.log(volume)
    wrong = np.logaddexp(np.log(LOOK_ALIKE) + logsumexp(own + agree), np.log1p(-LOOK_ALIKE) + anywhere)
    return [own + agree + right - wrong, np.array([np.log(NOWHERE) + anywhere + right - wrong])]


def _fused_positions(old: Candidates, fix: PoseFix) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Products of two normal densities: mean, spread, and the logarithm of how far they overlap."""
    own, its = old.position_spreads**2, fix.sigma_m**2
    share = its / (own + its)
    mean = share * old.positions_xyz + (1 - share) * fix.position_xyz
    off = (old.positions_xyz - fix.position_xyz) ** 2 / (own + its)
    agree = -0.5 * (off + np.log(2 * np.pi * (own + its))).sum(axis=1)
    return mean, np.sqrt(own * its / (own + its)), agree


def _fused_orientations(old: Candidates, fix: PoseFix) -> tuple[FloatArray, FloatArray, FloatArray]:
    own, its = old.orientation_spreads_rad**2, fix.sigma_rad**2
    fixed = Rotation.from_quat(fix.orientation_quat_wxyz, scalar_first=True)
    away = (fixed.inv() * Rotation.from_quat(old.orientations_quat_wxyz, scalar_first=True)).as_rotvec()
    mean = fixed * Rotation.from_rotvec((its / (own + its))[:, None] * away)
    agree = -0.5 * ((away**2).sum(axis=1) / (own + its) + 3 * np.log(2 * np.pi * (own + its)))
    return mean.as_quat(scalar_first=True), np.sqrt(own * its / (own + its)), agree


def _best(log_mass: FloatArray) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """The most probable, most probable first, and their log probabilities."""
    log_mass = log_mass - logsumexp(log_mass)
    order = np.argsort(-log_mass, kind="stable")[:MAX_CANDIDATES]
    order = order[log_mass[order] >= min(np.log(MIN_MASS), log_mass[order[0]])]
    return order, log_mass[order]
