"""A finder without a network: what the most similar training frames say, as softmaxes like the others'."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from conformodal.conformal import QuantileBins
from conformodal.reasoning import fit_growth
from conformodal.vision import LeftOut, LocalAnswers, LocalRegression

FloatArray = npt.NDArray[np.float64]
Probabilities = list[npt.NDArray[np.floating[Any]]]

_USUAL = 0.9  # images stranger than this share of those that were left out are trusted less than errors there tell
_DISTRUST = 4  # power of the strangeness beyond that


@dataclass(frozen=True, eq=False)
class LocalFinder:
    """A local regression and its say in the search.

    Attributes
    ----------
    regression
        Among the frames that the other finders were trained on.
    typical, limit
        Strangeness in the middle, and at the upper end, of what is usual.
    growth
        Its errors grow with this power of strangeness.
    sigma_bins
        Width of its labels, that of the heads'.
    """

    regression: LocalRegression
    typical: float
    limit: float
    growth: float
    sigma_bins: float

    def strangeness(self, answers: LocalAnswers) -> FloatArray:
        """(n,) how strange images are, in units of what is typical."""
        return np.maximum(answers.strangeness / self.typical, 1e-3)

    def blend(self, proba: Probabilities, answers: LocalAnswers, bins: QuantileBins) -> Probabilities:
        """Weighted means of other softmaxes, d arrays (n, K_j), and this finder's for the same images.

        Its own are the order-aware labels of its answers, one peak a place. The stranger an image is to its neighbours
        (a place never seen, noise), the less they count: as much as all others together where strangeness is typical.
        """
        variance = self.strangeness(answers) ** (2 * self.growth)
        variance *= np.maximum(answers.strangeness / self.limit, 1) ** _DISTRUST
        part = (1 / (1 + variance))[:, None]
        own = place_labels(answers, bins, self.sigma_bins)
        return [(1 - part) * theirs + part * mine for theirs, mine in zip(proba, own, strict=True)]


def place_labels(answers: LocalAnswers, bins: QuantileBins, sigma_bins: float) -> list[FloatArray]:
    """Order-aware labels around every place's answer, weighted: d arrays (n, K_j), rows of which sum to one."""
    n, places, d = answers.values.shape
    labels = bins.soft_targets(answers.values.reshape(-1, d), sigma_bins)
    return [np.einsum("np,npk->nk", answers.weights, label.reshape(n, places, -1)) for label in labels]


def make_finder(regression: LocalRegression, left_out: LeftOut, sigma_bins: float) -> LocalFinder:
    """A finder that knows from samples left out how errors grow with strangeness.

    Parameters
    ----------
    regression, left_out
        From :func:`~conformodal.vision.fit_local`.
    sigma_bins
        Width of labels, in bins.
    """
    strange = left_out.answers.strangeness
    typical = max(float(np.median(strange)), 1e-9)
    limit = max(float(np.quantile(strange, _USUAL)), typical)
    miss = (left_out.answers.best - regression.targets[left_out.rows]) / regression.target_scale
    finder = LocalFinder(regression, typical, limit, 0.0, sigma_bins)
    return replace(finder, growth=fit_growth(np.linalg.norm(miss, axis=1), finder.strangeness(left_out.answers)))
