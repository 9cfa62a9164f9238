"""conformodal and its peers behind one call: a split in, sets for the test part out.

Every peer gets the learner it is best with, tuned by cross-validation on the training part; the same training,
calibration and test samples; standardised inputs where it is a network.
"""

from __future__ import annotations

import logging
import sys
import tempfile
import types
import warnings
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from measure import Sets, one_interval
from ngboost import NGBRegressor
from problems import Split
from quantile_forest import RandomForestQuantileRegressor
from sklearn.base import clone
from sklearn.ensemble import (
    ExtraTreesRegressor,
    HistGradientBoostingRegressor,
    RandomForestClassifier,
    RandomForestRegressor,
)
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import make_scorer, mean_pinball_loss
from sklearn.model_selection import GridSearchCV, KFold, cross_val_predict
from sklearn.neighbors import KNeighborsClassifier, NearestNeighbors
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from conformodal.conformal import (
    ConformalRegressor,
    QuantileBins,
    QuickDensity,
    Regions,
    SplitConformal,
    StackedDensity,
)
from conformodal.core.arrays import FloatArray

torch.set_num_threads(1)  # networks this small are no faster with more
# gradient steps of r2ccp at its own batch of 32; its default of 1000 epochs is kept where that is fewer
R2CCP_STEPS = 20_000
NETWORK_STEPS = 8_000  # TorchCP's; its training does nothing unless it is told to be verbose
BOOSTING_GRID = {"learning_rate": [0.03, 0.1], "max_leaf_nodes": [15, 63]}
BOOSTING = {"max_iter": 300, "min_samples_leaf": 10, "max_features": 0.5}


def conformodal(make: Callable[[int], Any], split: Split, alpha: float) -> Sets:
    """Sets of what `make` makes of a seed, as the estimator."""
    reg = ConformalRegressor(make(split.seed), alpha=alpha, calibration_size=0, random_state=split.seed)
    reg.fit(split.X["train"], split.y["train"]).conformalize(split.X["cal"], split.y["cal"])
    return sets_of(reg.predict_region(split.X["test"]))


def sampler(split: Split, alpha: float) -> Sets:
    """Samples as of a generative model, here the targets of the 50 nearest rows: docs/howto/distributions.md."""
    scale = StandardScaler().fit(split.X["train"])
    nearest = NearestNeighbors(n_neighbors=50).fit(scale.transform(split.X["train"]))
    bins = QuantileBins(200, margin=0.02).fit(split.y["train"])
    rows = (nearest.kneighbors(scale.transform(split.X[part]), return_distance=False) for part in ("cal", "test"))
    cal, test = (bins.proba_from_samples(split.y["train"][index]) for index in rows)
    return sets_of(SplitConformal(bins, alpha, "density").calibrate(cal, split.y["cal"]).predict(test))


def sets_of(regions: Regions) -> Sets:
    """Regions as sets whose upper ends are closed, as those of the peers."""
    offsets, ends = regions.flat_intervals(0)
    last = ends[:, 1] == regions.bins.edges_[0][-1]
    high = np.where(last | np.isinf(ends[:, 1]), ends[:, 1], np.nextafter(ends[:, 1], -np.inf))
    return Sets(len(regions), np.repeat(np.arange(len(regions)), np.diff(offsets)), ends[:, 0], high)


def mapie_cqr_boosting(split: Split, alpha: float) -> Sets:
    """MAPIE's conformalised quantile regression; boosting tuned by the pinball losses of both quantiles."""
    from mapie.regression import ConformalizedQuantileRegressor

    folds = KFold(3, shuffle=True, random_state=split.seed)

    def tuned(level: float) -> Any:
        pinball = make_scorer(mean_pinball_loss, alpha=level, greater_is_better=False)
        model = HistGradientBoostingRegressor(loss="quantile", quantile=level, random_state=split.seed, **BOOSTING)
        search = GridSearchCV(model, BOOSTING_GRID, scoring=pinball, cv=folds)
        return search.fit(split.X["train"], split.y["train"]).best_estimator_

    median = HistGradientBoostingRegressor(loss="absolute_error", random_state=split.seed, **BOOSTING)  # of no account
    models = [tuned(alpha / 2), tuned(1 - alpha / 2), median.fit(split.X["train"], split.y["train"])]
    cqr = ConformalizedQuantileRegressor(models, confidence_level=1 - alpha, prefit=True)
    cqr.conformalize(split.X["cal"], split.y["cal"])
    _, intervals = cqr.predict_interval(split.X["test"], allow_infinite_bounds=True, symmetric_correction=True)
    return one_interval(intervals[:, 0, 0], intervals[:, 1, 0])


def _best_regressor(split: Split) -> Any:
    """Boosting from its grid, or a forest, whichever has the smallest cross-validated squared error."""
    X, y = split.X["train"], split.y["train"]
    folds = KFold(3, shuffle=True, random_state=split.seed)
    boosting = HistGradientBoostingRegressor(random_state=split.seed, **BOOSTING)
    search = GridSearchCV(boosting, BOOSTING_GRID, scoring="neg_mean_squared_error", cv=folds).fit(X, y)
    models = [(-search.best_score_, search.best_estimator_)]
    for kind in (RandomForestRegressor, ExtraTreesRegressor):
        model = kind(200, random_state=split.seed)
        error = float(np.mean((cross_val_predict(model, X, y, cv=folds) - y) ** 2))
        models.append((error, model.fit(X, y)))
    return min(models, key=lambda pair: pair[0])[1]


def mapie_conditional(split: Split, alpha: float) -> Sets:
    """MAPIE's conditional regressor (Gibbs, Cherian and Candes 2023), on the same regressor as crepes.

    Its guarantee is over a learnt spread and, as Mondrian's, within each quarter of it.
    """
    from mapie.conditional_conformal_prediction import ConditionalSplitConformalRegressor

    best, X, y = _best_regressor(split), split.X["train"], split.y["train"]
    folds = KFold(3, shuffle=True, random_state=split.seed)
    spread = RandomForestRegressor(200, min_samples_leaf=10, max_features=0.5, random_state=split.seed)
    spread.fit(X, np.abs(y - cross_val_predict(clone(best), X, y, cv=folds)))
    cuts = np.quantile(spread.predict(split.X["cal"]), (0.25, 0.5, 0.75))
    spreads = {part: spread.predict(split.X[part]) for part in ("cal", "test")}
    rows = {row.tobytes(): at for part in spreads for row, at in zip(split.X[part], spreads[part], strict=True)}

    def features(X: FloatArray) -> FloatArray:
        at = np.array([rows[row.tobytes()] for row in X])  # it asks row by row
        return np.column_stack((np.ones(len(at)), at, np.searchsorted(cuts, at)[:, None] == np.arange(1, 4)))

    conditional = ConditionalSplitConformalRegressor(features, best, confidence_level=1 - alpha)
    conditional.conformalize(split.X["cal"], split.y["cal"])
    _, intervals = conditional.predict_interval(split.X["test"])
    return one_interval(intervals[:, 0, 0], intervals[:, 1, 0])


def crepes_normalized(split: Split, alpha: float, *, cps: bool = False) -> Sets:
    """crepes: residuals scaled by a difficulty learnt from cross-validated residuals of nearest neighbours.

    With `cps` its conformal predictive system, between the quantiles alpha / 2 and 1 - alpha / 2.
    """
    from crepes import WrapRegressor
    from crepes.extras import DifficultyEstimator

    best = _best_regressor(split)
    folds = KFold(3, shuffle=True, random_state=split.seed)
    X, y = split.X["train"], split.y["train"]
    residuals = y - cross_val_predict(clone(best), X, y, cv=folds)
    difficulty = DifficultyEstimator()
    difficulty.fit(X=X, residuals=residuals, k=25, scaler=True, beta=0.05)
    wrapped = WrapRegressor(best)
    wrapped.calibrate(split.X["cal"], split.y["cal"], de=difficulty, cps=cps, seed=split.seed)
    intervals = wrapped.predict_int(split.X["test"], confidence=1 - alpha, seed=split.seed)
    return one_interval(intervals[:, 0], intervals[:, 1])


class _Learner:
    """The location and the spread that conformodal's default learns, offered to a peer."""

    def __init__(self, split: Split) -> None:
        edges = QuantileBins(200, margin=0.02).fit(split.y["train"]).edges_[0]
        self.density = QuickDensity(random_state=split.seed).fit_bins(split.X["train"], split.y["train"], edges)

    def predict(self, X: FloatArray) -> FloatArray:
        forest = self.density.forests_[-1]
        return self.density.location_.predict(X, forest.means(forest.apply(X)))

    def apply(self, X: FloatArray) -> FloatArray:
        return np.exp(self.density.spread_.predict(np.column_stack((X, self.predict(X)))))


def crepes_on_our_learner(split: Split, alpha: float) -> Sets:
    """crepes around conformodal's own location and spread: what is left is the gain of the density and the score."""
    from crepes import WrapRegressor

    learner = _Learner(split)
    location = types.SimpleNamespace(predict=lambda X: learner.predict(X)[:, 0], fit=None)
    wrapped = WrapRegressor(location)
    wrapped.fitted_ = True
    wrapped.calibrate(split.X["cal"], split.y["cal"], de=learner)
    intervals = wrapped.predict_int(split.X["test"], confidence=1 - alpha)
    return one_interval(intervals[:, 0], intervals[:, 1])


def _import_torchcp_regression() -> Any:
    """torchcp without its parts for graphs and language models, whose packages are not installed."""
    if "torchcp" not in sys.modules:
        spec = find_spec("torchcp")
        if spec is None or spec.origin is None:
            raise ImportError("torchcp is not installed: pip install --no-deps -r benchmarks/peers/requirements.txt")
        package = types.ModuleType("torchcp")
        package.__path__ = [str(Path(spec.origin).parent)]
        sys.modules["torchcp"] = package
    import torchcp.regression as regression

    return regression


def _loaders(split: Split) -> tuple[dict[str, Any], StandardScaler]:
    scaler = StandardScaler().fit(split.X["train"])
    loaders = {}
    for part in ("train", "cal"):
        X, y = (torch.tensor(a, dtype=torch.float32) for a in (scaler.transform(split.X[part]), split.y[part]))
        loaders[part] = torch.utils.data.DataLoader(
            torch.utils.data.TensorDataset(X, y), batch_size=64, shuffle=part == "train"
        )
    return loaders, scaler


def torchcp_cqr(split: Split, alpha: float) -> Sets:
    """TorchCP's CQR on its own network, 64 units; dropout chosen on a tenth of the training part.

    Its default loss subtracts (B,) from (B, 1) and so learns the marginal quantiles; it is given targets of shape (B,).
    """
    regression = _import_torchcp_regression()
    from torchcp.regression.utils import build_regression_model

    loaders, scaler = _loaders(split)
    whole = loaders["train"].dataset
    epochs = int(np.clip(NETWORK_STEPS // len(loaders["train"]), 30, 1000))
    n_val = max(len(whole) // 10, 1)
    generator = torch.Generator().manual_seed(split.seed)
    rest, held = torch.utils.data.random_split(whole, [len(whole) - n_val, n_val], generator=generator)
    X_held, y_held = whole[held.indices]

    def trained(data: Any, dropout: float) -> Any:
        torch.manual_seed(split.seed)
        model = build_regression_model("NonLinearNet")(X_held.shape[1], 2, 64, dropout)
        predictor = regression.SplitPredictor(regression.CQR(), model, alpha=alpha)
        loader = torch.utils.data.DataLoader(data, batch_size=64, shuffle=True)
        pinball = regression.loss.QuantileLoss([alpha / 2, 1 - alpha / 2])
        predictor.train(loader, criterion=lambda out, y: pinball(out, y[:, 0]), epochs=epochs, lr=3e-3)
        return predictor

    def loss(dropout: float) -> float:
        predictor = trained(rest, dropout)
        predictor._model.eval()
        with torch.no_grad():
            out = predictor._model(X_held).numpy()
        return sum(mean_pinball_loss(y_held, out[:, i], alpha=q) for i, q in enumerate((alpha / 2, 1 - alpha / 2)))

    predictor = trained(whole, min((0.0, 0.1, 0.5), key=loss))
    predictor.calibrate(loaders["cal"])
    X = torch.tensor(scaler.transform(split.X["test"]), dtype=torch.float32)
    intervals = predictor.predict(X)[:, 0].numpy()
    return one_interval(intervals[:, 0], intervals[:, 1])


def _import_r2ccp() -> Any:
    """r2ccp; torchvision, which it imports for images, is replaced by nothing."""
    import lightning.pytorch as pl

    for name in ("torchvision", "torchvision.models"):
        sys.modules.setdefault(name, types.ModuleType(name))
    sys.modules["torchvision"].models = sys.modules["torchvision.models"]  # type: ignore[attr-defined]
    sys.modules.setdefault("pytorch_lightning", pl)
    sys.modules.setdefault("pytorch_lightning.callbacks", pl.callbacks)
    from R2CCP.main import R2CCP

    return R2CCP


def r2ccp(split: Split, alpha: float) -> Sets:
    """The r2ccp package at its defaults, on our split: its own shuffle is undone beforehand."""
    from sklearn.model_selection import train_test_split

    R2CCP = _import_r2ccp()
    n_train, n_cal = len(split.y["train"]), len(split.y["cal"])
    share = (n_cal - 0.5) / (n_train + n_cal)  # it rounds up
    for name in ("pytorch_lightning", "lightning.pytorch", "lightning.pytorch.utilities.rank_zero", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    first, second = train_test_split(np.arange(n_train + n_cal), test_size=share, random_state=split.seed)
    assert (len(first), len(second)) == (n_train, n_cal)
    X = np.empty((n_train + n_cal, split.X["train"].shape[1]))
    y = np.empty(n_train + n_cal)
    X[first], X[second], y[first], y[second] = split.X["train"], split.X["cal"], split.y["train"], split.y["cal"]
    epochs = int(np.clip(R2CCP_STEPS // int(np.ceil(n_train / 32)), 10, 1000))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        options = {"model_path": f"{folder}/model.pth", "max_epochs": epochs, "seed": split.seed, "alpha": alpha}
        model = R2CCP({**options, "test_size": share})
        plain = sys.modules["R2CCP.main"].pl.Trainer

        def quiet(**kwargs: Any) -> Any:
            off = {"enable_progress_bar": False, "logger": False, "enable_checkpointing": False}
            return plain(**kwargs, **off, enable_model_summary=False, limit_val_batches=0)

        sys.modules["R2CCP.main"].pl = types.SimpleNamespace(Trainer=quiet)
        try:
            model.fit(X, y)
            intervals = model.get_intervals(split.X["test"])
        finally:
            sys.modules["R2CCP.main"].pl = types.SimpleNamespace(Trainer=plain)
    rows = np.repeat(np.arange(len(intervals)), [len(each) for each in intervals])
    ends = np.array([pair for each in intervals for pair in each], dtype=np.float64).reshape(-1, 2)
    return Sets(len(intervals), rows, ends[:, 0], ends[:, 1])


OURS, STACK, PROBE = "conformodal", "conformodal, stack", "crepes on conformodal's learner"
# other estimators, with their packages' default settings; two on standardised inputs
LEARNERS: dict[str, Callable[[int], Any]] = {
    "conformodal, random forest": lambda seed: RandomForestClassifier(random_state=seed),
    "conformodal, quantile-forest": lambda seed: RandomForestQuantileRegressor(random_state=seed),
    "conformodal, NGBoost": lambda seed: NGBRegressor(random_state=seed, verbose=False),
    "conformodal, k-NN": lambda seed: make_pipeline(StandardScaler(), KNeighborsClassifier()),
    "conformodal, logistic regression": lambda seed: make_pipeline(StandardScaler(), LogisticRegression(max_iter=300)),
}
PEERS: dict[str, Callable[[Split, float], Sets]] = {
    "MAPIE CQR, boosting": mapie_cqr_boosting,
    "MAPIE conditional": mapie_conditional,
    "crepes, normalised": crepes_normalized,
    "crepes, predictive system": partial(crepes_normalized, cps=True),
    PROBE: crepes_on_our_learner,
    "TorchCP CQR": torchcp_cqr,
    "r2ccp": r2ccp,
}
METHODS: dict[str, Callable[[Split, float], Sets]] = {
    OURS: partial(conformodal, lambda seed: QuickDensity(random_state=seed)),
    STACK: partial(conformodal, lambda seed: StackedDensity(random_state=seed)),
    **{name: partial(conformodal, make) for name, make in LEARNERS.items()},
    "conformodal, 50 nearest samples": sampler,
    **PEERS,
}
