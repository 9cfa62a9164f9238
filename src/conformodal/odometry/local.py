"""A finder without a network: fixes from the most similar training frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from conformodal.poses import PoseFix, angle_between_quats, normalise_quat
from conformodal.vision import LeftOut, LocalAnswers, LocalRegression

from .fix_scale import FixErrors, FixScale, fit_fix_scale

FloatArray = npt.NDArray[np.float64]

_LEAST_WEIGHT = 0.02  # places that fewer neighbours speak for are none
_SAME_PLACE = 0.5  # in units of the targets' spread
_USUAL = 0.9  # images stranger than this share of those left out are new; what was learnt from these says little then
_DISTRUST = 4  # power of the strangeness beyond that by which the odds of being right fall


@dataclass(frozen=True, eq=False)
class LocalFinder:
    """A local regression and how far it is off.

    Attributes
    ----------
    regression
        Among the frames that the finders were trained on.
    typical, limit
        Strangeness in the middle, and at the upper end, of what is usual.
    scale
        How errors grow with strangeness.
    """

    regression: LocalRegression
    typical: float
    limit: float
    scale: FixScale

    def strangeness(self, answers: LocalAnswers) -> FloatArray:
        """(n,) how strange images are, in units of what is typical."""
        return _strangeness(answers, self.typical)

    def fixes(self, answers: LocalAnswers) -> list[list[PoseFix]]:
        """For every image, a pose a place; the stranger the image is to its neighbours, the less they are trusted."""
        found = []
        for values, weights, strange in zip(
            answers.values, answers.weights, self.strangeness(answers).tolist(), strict=True
        ):
            here, beyond = [], max(strange * self.typical / self.limit, 1.0)
            for k in np.flatnonzero(weights >= _LEAST_WEIGHT):
                raw = PoseFix(
                    values[k, :3], normalise_quat(values[k, 3:]), strange, strange, self.regression.settings.neighbours
                )
                fix = self.scale.apply(raw, 1 / strange)
                # weights are shares of one answer: that all places are wrong is no likelier where there are several
                odds = fix.trust / (1 - fix.trust) * beyond**-_DISTRUST * float(weights[k])
                trust = odds / (1 + odds)
                here.append(replace(fix, trust=trust, sigma_m=fix.sigma_m * beyond, sigma_rad=fix.sigma_rad * beyond))
            found.append(here)
        return found


def make_finder(regression: LocalRegression, left_out: LeftOut) -> LocalFinder | None:
    """A finder that knows from samples left out how errors grow with strangeness; None where these are too few.

    Parameters
    ----------
    regression, left_out
        From :func:`~conformodal.vision.fit_local`.
    """
    answers, truth = left_out.answers, regression.targets[left_out.rows]
    typical = max(float(np.median(answers.strangeness)), 1e-9)
    strange = _strangeness(answers, typical)
    same_place = _SAME_PLACE * float(regression.target_scale[0])
    there = answers.weights >= _LEAST_WEIGHT
    values = np.where(there[:, :, None], answers.values, truth[:, None])
    off = np.linalg.norm(values[:, :, :3] - truth[:, None, :3], axis=2)
    turned = angle_between_quats(values[:, :, 3:], truth[:, None, 3:])
    apart = np.where(there, off / same_place + turned, np.inf)
    nearest = np.arange(len(off)), apart.argmin(axis=1)
    unknown, alike = np.zeros(len(off)), np.ones(len(off))
    errors = FixErrors(off[nearest], strange, turned[nearest], strange, unknown, 1 / strange[:, None], alike)
    scale = fit_fix_scale(errors, same_place)
    limit = max(float(np.quantile(answers.strangeness, _USUAL)), typical)
    return None if scale is None else LocalFinder(regression, typical, limit, scale)


def _strangeness(answers: LocalAnswers, typical: float) -> FloatArray:
    return np.maximum(answers.strangeness / typical, 1e-3)
