"""A nonconformity score of one's own: the probability of all bins that are at least as probable, to a power.

python examples/custom_score.py
"""

import numpy as np

from conformodal import QuantileBins, SplitConformal
from conformodal.conformal import register_score


class TemperedRank:  # a conformodal.conformal.Score
    name = "tempered_rank"
    normalised = True  # scores of different targets are comparable

    def __init__(self, power: float = 2.0) -> None:
        self.power = power

    def of_bins(self, proba, widths):
        order = np.argsort(-proba / widths, axis=1, kind="stable")
        ranked = np.cumsum(np.take_along_axis(proba, order, axis=1), axis=1)
        scores = np.empty_like(proba)
        np.put_along_axis(scores, order, ranked**self.power, axis=1)
        return scores


if __name__ == "__main__":
    rng = np.random.default_rng(0)
    y = np.where(rng.random(2000) < 0.5, -1.0, 1.0) + rng.normal(0, 0.1, 2000)  # here or there
    bins = QuantileBins(n_bins=20).fit(y)
    proba = np.tile(1 / 20, (2000, 20))
    register_score(TemperedRank())  # a name for the command line and settings, too
    calibrated = SplitConformal(bins, alpha=0.1, score="tempered_rank").calibrate(proba[:1000], y[:1000])
    regions = calibrated.predict(proba[1000:])
    print(f"covered: {regions.contains(y[1000:]).mean():.3f} of 1000, guaranteed at least 0.9 for exchangeable samples")
    print(f"intervals: {regions.intervals(0)[0].round(2).tolist()}")
