"""A scikit-learn regressor that predicts regions."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypeAlias, overload

import numpy as np
import numpy.typing as npt
from scipy.sparse import issparse
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.frozen import FrozenEstimator
from sklearn.utils import check_random_state, get_tags
from sklearn.utils.validation import check_is_fitted, validate_data

from conformodal.core.arrays import AnyArray, BoolArray, FloatArray
from conformodal.core.errors import ConformodalError
from conformodal.core.ranges import Range
from conformodal.core.words import counted

from .bins import QuantileBins
from .calibrators.base import Joint
from .calibrators.mondrian import MondrianConformal
from .calibrators.split import SplitConformal
from .checks import (
    Alpha,
    BinProbabilities,
    ConformodalTypeError,
    as_alpha,
    as_choice,
    as_known_labels,
    as_labels,
    as_probabilities,
    as_reals,
    as_targets,
    brief,
    check_number,
    column_names,
    doubt_alpha,
    factorise,
    not_calibrated,
)
from .choice import choose_score
from .density.encoder import (
    column_of,
    columns_where,
    dates_of_text,
    first_other_than_dates,
    is_empty,
    is_frame,
    is_text,
    named_targets,
    numpy_columns,
    rows_of,
    with_columns,
)
from .density.learners import FittedTarget, as_learner, fit_target, predict_proba, split_off, split_units
from .density.mixture import as_sample_weight
from .diagnosis import Diagnosis, diagnose
from .doubts import DataWarning, TableMemory, Unlike, doubt_rows, doubt_seen
from .predictive import PredictiveDensity
from .regions import Regions
from .saving import load_regressor, save_regressor
from .scores import Score
from .tables import region_table

Calibration: TypeAlias = Literal["random", "last"]
Alphas: TypeAlias = Sequence[float] | Sequence[str] | FloatArray

# Values a little beyond the training range still get a finite score.
_MARGIN = 0.02
_CALIBRATION_SIZE = Range(0, 1, "[)")
# With few calibration samples, one beyond that would make all regions unbounded: bins reach as far again as the range.
_TAIL, _FEW_TO_CALIBRATE = 1.0, 100
_BINS_OF_DENSITY, _BINS_OF_CLASSIFIER = 200, 50
_CHOSEN = "auto"  # a score by training rows


class ConformalRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Regression by classification into bins, with calibrated regions of one or more intervals.

    ``fit`` splits off calibration data, cuts the targets into quantile bins, fits one density or classifier per target
    and calibrates. If calibration samples and a new sample are exchangeable, ``predict_region`` contains the truth with
    probability at least ``1 - alpha``, on average over samples: per target, or of all together with `joint`.

    Parameters
    ----------
    estimator
        None or ``"quick"`` for :class:`QuickDensity`, in seconds; ``"stack"`` for :class:`StackedDensity`, in minutes
        with shorter sets; any classifier with ``predict_proba``, fitted five times on bin numbers without every fifth
        row, averaged, and smoothed over bins as the left-out rows require; a regressor that predicts distributions as
        NGBoost, quantile-forest and TabICL do, or by ``predict_quantiles(X, levels)``; or an object with
        ``fit_bins(X, y, edges)`` and ``predict_proba``. One in scikit-learn's ``FrozenEstimator`` is not fitted again:
        give ``fit`` samples that it has not seen, else sets are too small; a :class:`DataWarning` tells if it seems so.
    n_bins
        Bins per target. None: 200 for an object with ``fit_bins`` (these smooth over bins), 50 for a classifier.
    alpha
        Miscoverage rate in (0, 1).
    conformity_score
        ``"density"`` (shortest sets), ``"interval"`` (one interval), ``"lac"``, ``"aps"``, ``"hpd"``, a score object;
        or ``"auto"``, which chooses on training rows that the learner has not learnt from: a density scaled by a power
        of its entropy (:class:`ScaledDensity`), so that the rows with the widest distributions are covered nearly as
        often as others, or ``"interval"`` where it covers these as often and its sets are no longer. For a learner of
        another package that predicts distributions, it is ``"density"``.
    joint
        ``"none"``, ``"bonferroni"`` or ``"max"``; see :class:`~conformodal.conformal.SplitConformal`. With ``"max"``
        every density is fitted twice: the targets' scores are scaled by rows that one of the fits has not seen.
    calibration_size
        Share of the samples that ``fit`` holds out for calibration, in [0, 1). With 0, call :meth:`conformalize` next.
    random_state
        Seed of the split and of a fresh estimator, or None.
    y_min, y_max
        Bounds that no value can pass, such as 0 for a weight: no set reaches beyond them, an unbounded one neither. A
        number for all targets, or one per target.
    unlike
        Sets of new rows that miss a value, or have a label, where no row of `fit` does: ``"unbounded"``, as nothing is
        known about them, or, with ``"ignore"``, those of any other row, which may rarely contain the truth. Both are
        told by a :class:`DataWarning`, which counts such rows, and those with numbers beyond the range of `fit`.
    calibration
        The samples held out for calibration: ``"random"``, or the ``"last"``, of samples in the order of time.

    Attributes
    ----------
    bins_ : QuantileBins
    estimators_ : list of d fitted estimators; of a classifier, its five fits in ``classifiers`` and their smoothing
    calibrator_ : SplitConformal, or MondrianConformal with groups
    columns_, group_column_ : names of the columns of `X` and of `groups`, which ``predict_table`` reads

    Examples
    --------
    >>> import numpy as np
    >>> from sklearn.ensemble import RandomForestClassifier
    >>> from conformodal.conformal import ConformalRegressor
    >>> rng = np.random.default_rng(0)
    >>> X = rng.uniform(-1, 1, (1000, 1))
    >>> y = rng.choice([-1, 1], 1000) * (1 + X[:, 0]) + rng.normal(0, 0.05, 1000)
    >>> forest = RandomForestClassifier(min_samples_leaf=20, random_state=0)
    >>> reg = ConformalRegressor(forest, n_bins=30, random_state=0).fit(X, y)
    >>> [[float(round(end)) for end in interval] for interval in reg.predict_region([[0.9]]).intervals(0)[0]]
    [[-2.0, -2.0], [2.0, 2.0]]
    """

    file_format_: dict[str, Any]  # of the file that the command line has fitted it on
    # what a pipeline passes on if scikit-learn's metadata routing is on
    __metadata_request__predict: ClassVar = {"region": True, "alpha": True, "groups": True}

    def __init__(
        self,
        estimator: Any = None,
        n_bins: int | None = None,
        alpha: Alpha = 0.1,
        conformity_score: str | Score = _CHOSEN,
        joint: Joint = "none",
        calibration_size: float = 0.2,
        random_state: Any = None,
        y_min: npt.ArrayLike = -np.inf,
        y_max: npt.ArrayLike = np.inf,
        unlike: Unlike = "unbounded",
        calibration: Calibration = "random",
    ) -> None:
        self.estimator = estimator
        self.n_bins = n_bins
        self.alpha = alpha
        self.conformity_score = conformity_score
        self.joint = joint
        self.calibration_size = calibration_size
        self.random_state = random_state
        self.y_min = y_min
        self.y_max = y_max
        self.unlike = unlike
        self.calibration = calibration

    def fit(
        self,
        X: Any,
        y: Any,
        sample_weight: npt.ArrayLike | None = None,
        groups: npt.ArrayLike | None = None,
        units: npt.ArrayLike | None = None,
    ) -> Self:
        """Learn and calibrate.

        A :class:`DataWarning` tells of samples whose coverage is not that of new ones: identical rows, units of several
        rows, and an order (of an index, or dates) in which neighbours are alike; and what mends it.

        Parameters
        ----------
        X
            (n, p) features: an array, or a frame of pandas, polars or Arrow, of which a classifier gets the rows as
            they are. Numbers may be missing (NaN) if the estimator can work with that, as the named ones do. These read
            text of ISO 8601 dates as dates, and a :class:`DataWarning` says so.
        y
            (n,) or (n, d) values; the names of a frame's or series' columns are kept.
        sample_weight
            (n,) weights of at least 0, up to a factor, for the learner only (``"stack"`` takes none). Samples of weight
            0 are left out. All others calibrate alike: coverage is guaranteed for a new sample that is exchangeable
            with the samples of positive weight, not for a population in which samples are as frequent as they weigh;
            for that, calibrate :class:`ConditionalConformal` on :meth:`predict_bins`, with the weights as a condition.
        groups
            (n,) labels, as text, numbers or dates: coverage is then guaranteed within each group, see
            :class:`MondrianConformal`; each is split by itself. For groups that overlap, see
            :class:`ConditionalConformal`.
        units
            (n,) labels of what rows were drawn together in, such as a subject, which should not be an input: units
            are held out whole, and coverage is guaranteed for a random row of a new unit (not with `groups`).
        """
        features, values, names = self._table(X, y, reset=True)
        self._one_target = values.ndim == 1
        values = as_targets(values)
        labels = None if groups is None else as_labels(groups, len(values))
        self.group_column_ = None if groups is None else getattr(groups, "name", None)
        members = None if units is None else as_labels(units, len(values), "units")
        weight = None if sample_weight is None else as_sample_weight(sample_weight, len(values))
        if weight is not None:
            some = weight > 0
            features, values, weight = rows_of(features, some), values[some], weight[some]
            labels, members = (None if of is None else of[some] for of in (labels, members))
        as_choice(self.calibration, Calibration, "calibration")
        as_choice(self.unlike, Unlike, "unlike")
        if members is not None and (labels is not None or self.calibration == "last"):
            raise ConformodalError("units must be None with groups or calibration='last'")
        doubts = doubt_rows(features, values, members is not None, self.calibration == "last")
        dated = [f"{name} is read as dates, from text such as {text!r}" for name, text in self.text_dates_.items()]
        if doubts := [*filter(None, [doubt_alpha(self.alpha)]), *dated, *doubts]:
            warnings.warn("; and ".join(doubts), DataWarning, stacklevel=2)
        size = check_number(self.calibration_size, "calibration_size", _CALIBRATION_SIZE)
        random = check_random_state(self.random_state)
        held_out, training = split_off(len(values), size, random, None if labels is None else factorise(labels)[1])
        if self.calibration == "last":
            held_out, training = np.split(np.arange(len(values))[::-1], [held_out.size])
            training = random.permutation(training)
        elif members is not None:
            held_out, training = split_units(members, size, as_alpha(self.alpha), random)
        base, dense = as_learner(self.estimator, random.randint(2**31 - 1))
        n_bins = self.n_bins if self.n_bins is not None else _BINS_OF_DENSITY if dense else _BINS_OF_CLASSIFIER
        n_units = held_out.size if members is None else np.unique(members[held_out]).size
        tail = _TAIL if 0 < n_units < _FEW_TO_CALIBRATE else 0.0
        bins = QuantileBins(n_bins, margin=_MARGIN, tail=tail, y_min=self.y_min, y_max=self.y_max)
        self.bins_ = bins.fit(values[training])
        self.bins_.check_limits(values)
        self.bins_.names = names
        self.memory_ = TableMemory().learn(features)
        self.calibrator_: Any = self._calibrator(labels is not None)
        learnt = rows_of(features, training)
        share = None if weight is None else weight[training]
        fits = [
            fit_target(base, dense, learnt, values[training, j], edges, share, self.joint == "max")
            for j, edges in enumerate(self.bins_.edges_)
        ]
        self.estimators_ = [fit.model for fit in fits]
        self._tune(fits, learnt, values[training])
        if held_out.size:
            of_groups, of_units = (None if of is None else of[held_out] for of in (labels, members))
            self._calibrate(rows_of(features, held_out), values[held_out], of_groups, of_units)
        return self

    def conformalize(self, X_cal: Any, y_cal: Any, groups: npt.ArrayLike | None = None) -> Self:
        """Calibrate on given data, none of which was learnt from; replaces the earlier calibration."""
        check_is_fitted(self, "bins_")
        features, values, _ = self._table(X_cal, y_cal)
        values = as_targets(values, self.bins_.n_targets)
        self.bins_.check_limits(values)
        self._calibrate(features, values, self._labels(groups, len(values)))
        self.memory_.learn(features)
        return self

    def predict_bins(self, X: Any) -> BinProbabilities:
        """Probabilities of the bins: d arrays (n, K_d)."""
        return self._compared(X)[0]

    def _compared(self, X: Any) -> tuple[BinProbabilities, BoolArray]:
        """Probabilities, and whether each row is of a kind that never occurred; warns of rows unlike the training's."""
        check_is_fitted(self, "bins_")
        features = self._inputs(X)
        return self.proba_of(features), self.compare_rows(features)

    def compare_rows(self, features: Any) -> BoolArray:
        """Whether the set of each row is unbounded as nothing is known about its kind; warns of unlike rows."""
        unlike, words = self.memory_.compare(features)
        if words:
            unbounded = unlike.any() and self.unlike == "unbounded"
            sets = f"; sets of the {unlike.sum()} with what never occurred are unbounded" if unbounded else ""
            warnings.warn(f"rows unlike those of fit: {words}{sets}", DataWarning, stacklevel=5)
        return unlike & (self.unlike == "unbounded")

    def predict_density(self, X: Any) -> PredictiveDensity:
        """Distributions of new samples: density, quantiles, mode, samples, and the probability of each interval."""
        proba = self.predict_bins(X)  # refuses before fit
        return PredictiveDensity(self.bins_, proba)

    def predict(
        self, X: Any, region: bool = False, alpha: Alpha | Alphas | None = None, groups: npt.ArrayLike | None = None
    ) -> Any:
        """Means of the distributions, (n,) or (n, d), which minimise the squared error, even between two modes.

        With ``region=True`` it is :meth:`predict_region`, for scikit-learn, which knows ``predict`` only: the regions
        of a pipeline are ``pipeline.predict(X, region=True)``.
        """
        if region:
            return self.predict_region(X, alpha, groups)
        if alpha is not None or groups is not None:
            raise ConformodalError("alpha and groups must be None unless region=True")
        means = self.predict_density(X).mean
        return means[:, 0] if self._one_target else means

    @overload
    def predict_region(self, X: Any, alpha: Alpha | None = None, groups: npt.ArrayLike | None = None) -> Regions: ...

    @overload
    def predict_region(self, X: Any, alpha: Alphas, groups: npt.ArrayLike | None = None) -> list[Regions]: ...

    def predict_region(
        self, X: Any, alpha: Alpha | Alphas | None = None, groups: npt.ArrayLike | None = None
    ) -> Regions | list[Regions]:
        """Calibrated regions of new samples; `alpha` replaces the estimator's miscoverage rate.

        For a list of rates, a list of regions: those of a smaller rate hold those of a larger one.

        `groups` (n,) are the samples' labels if the regressor was fitted with labels; those of a group that is new, or
        had too few calibration samples, are unbounded. Those without a label have the largest threshold of all groups,
        and a :class:`DataWarning` counts them.
        """
        proba, unlike = self._compared(X)
        self.warn_without_group(groups)
        if isinstance(alpha, (list, tuple, np.ndarray)) and np.ndim(alpha):
            return [self.regions_of(proba, unlike, rate, groups) for rate in alpha]
        return self.regions_of(proba, unlike, alpha, groups)  # type: ignore[arg-type]

    def regions_of(
        self, proba: BinProbabilities, unlike: BoolArray, alpha: Alpha | None, groups: npt.ArrayLike | None
    ) -> Regions:
        """Regions of rows with these probabilities; those of :meth:`compare_rows` are unbounded."""
        calibrator = self._calibrated()
        self._check_grouped(groups)
        at = calibrator if alpha is None else calibrator.at(alpha)
        sets = at.predict(*([proba] if groups is None else [proba, groups]))
        return Regions(self.bins_, sets.masks, sets.unbounded | unlike[:, None])

    def predict_table(self, table: Any, alpha: Alpha | None = None) -> Any:
        """Regions of the rows of a table of pandas, polars or Arrow, as a table of the same kind; extra ``arrow``.

        A pure function of the rows, for ``map_batches`` of Ray and ``map_partitions`` of Dask. Columns are
        taken by name: their order does not matter, and those that were not learnt from are passed over. For each target
        Y the result has the columns ``Y`` (the mean, as :meth:`predict`), ``Y_low`` and ``Y_high`` (the ends of the
        set, null if it is empty), and ``Y_intervals``: a list of intervals with ``low``, ``high`` and ``probability``.
        """
        check_is_fitted(self, "bins_")
        return region_table(self, table, alpha)

    def diagnose(self, X: Any, y: Any, groups: npt.ArrayLike | None = None, level: float = 0.99) -> Diagnosis:
        """Check coverage and sizes on test samples; print the result for a report.

        Takes samples neither learnt from nor calibrated on; the other parameters are those of
        :func:`~conformodal.conformal.diagnose`.
        """
        calibrator, (proba, unlike) = self._calibrated(), self._compared(X)
        regions = self.regions_of(proba, unlike, None, groups if isinstance(calibrator, MondrianConformal) else None)
        return diagnose(calibrator, proba, self._table(X, y)[1], groups, level, regions)

    def save(self, path: str | Path) -> None:
        """Write the regressor into a file, with the extra ``save``: skops, which needs no pickle.

        An existing file is replaced only if it is a saved regressor. Estimators of scikit-learn and the named ones can
        be saved.
        """
        check_is_fitted(self, "bins_")
        save_regressor(self, path)

    @classmethod
    def load(cls, path: str | Path, trusted: Sequence[str] = ()) -> Self:
        """Read a saved regressor back, best with the version of scikit-learn that it was saved with.

        Loading runs no code of the file. It makes objects of known types only; `trusted` names more of them, such as
        those of an estimator of another package, which the error about them lists.
        """
        regressor = load_regressor(path, trusted)
        if not isinstance(regressor, cls):
            raise ConformodalError(f"{path}: is not a saved {cls.__name__}")
        return regressor

    def _calibrator(self, grouped: bool) -> Any:
        kind = MondrianConformal if grouped else SplitConformal
        score = "density" if self.conformity_score == _CHOSEN else self.conformity_score
        calibrator = kind(self.bins_, self.alpha, score, self.joint)
        calibrator.check_parameters()
        return calibrator

    def _inputs(self, X: Any, reset: bool = False) -> Any:
        """Features, checked by scikit-learn; a frame stays as it is."""
        if np.ma.is_masked(X):
            raise ConformodalError("X must not hold masked entries; NaN stands for a missing number")
        X = self._with_dates(numpy_columns(X), reset)
        options: Any = {"accept_sparse": "csr", "ensure_all_finite": "allow-nan", "dtype": "numeric"}
        try:
            features = validate_data(self, X, reset=reset, **({"skip_check_array": True} if is_frame(X) else options))
        except TypeError as exc:
            raise ConformodalTypeError(brief(exc, 300)) from None
        except (ValueError, OverflowError) as exc:
            raise ConformodalError(brief(exc, 300)) from None
        columns = column_names(X, "X", None if reset else self.columns_)
        self.columns_: list[str] = columns if reset else self.columns_
        return features if is_frame(X) or issparse(features) else as_reals(features, "X")

    def _with_dates(self, X: Any, reset: bool) -> Any:
        """A frame with its text of ISO dates as dates, as the named learners take them; others get columns as given."""
        if reset:
            self.text_dates_: dict[str, str] = {}  # columns, and the first text of each
        if not is_frame(X) or not (self.estimator is None or isinstance(self.estimator, str)):
            return X
        asked = columns_where(X, is_text)
        asked = asked if reset else [j for j in asked if str(X.columns[j]) in getattr(self, "text_dates_", {})]
        found = {j: dates for j in asked if (dates := dates_of_text(column_of(X, j))) is not None}
        if reset:
            firsts = {j: next(text for text in column_of(X, j) if isinstance(text, str)) for j in found}
            self.text_dates_ = {str(X.columns[j]): text for j, text in firsts.items()}
        elif missed := [X.columns[j] for j in asked if j not in found and not is_empty(column_of(X, j))]:
            column = column_of(X, list(X.columns).index(missed[0]))
            row = first_other_than_dates(column) or 0
            told = f"got {brief(list(column)[row])} in row {row} (from 0)"
            raise ConformodalError(f"column {missed[0]} held dates in training, {told}; a missing date is None or NaT")
        return with_columns(X, found) if found else X

    def _table(self, X: Any, y: Any, reset: bool = False) -> tuple[Any, FloatArray, list[str] | None]:
        """Features, values and the targets' names."""
        if y is None:
            raise ConformodalError("y: this estimator requires y to be passed, but the target y is None")
        values, names = named_targets(y, None if reset else self.bins_.names)
        features = self._inputs(X, reset)
        if values.shape[:1] != features.shape[:1]:
            raise ConformodalError(
                f"y must have one value per row of X ({features.shape[0]}), got shape {values.shape}"
            )
        return features, values, names

    def warn_without_group(self, groups: npt.ArrayLike | None) -> None:
        """Warn of new samples without a label."""
        if groups is None:
            return
        gaps = as_known_labels(groups, len(np.asarray(groups)))[1]
        if (n := int(np.sum(gaps))) and isinstance(self.calibrator_, MondrianConformal):
            told = f"{n} of {counted(len(gaps), 'row')} without a group: the largest threshold of all groups holds"
            warnings.warn(told, DataWarning, stacklevel=3)

    def _check_grouped(self, groups: npt.ArrayLike | None) -> None:
        needed = isinstance(self.calibrator_, MondrianConformal)
        if needed != (groups is not None):
            raise ConformodalError(f"groups {'are needed, as fit had them' if needed else 'must be None, as in fit'}")

    def _tune(self, fits: list[FittedTarget], X: Any, y: FloatArray) -> None:
        """Choose the score, and scale those of several targets, by training rows `X` with values `y` (n, d)."""
        left_out = [fit.left_out for fit in fits if fit.left_out is not None]
        if self.conformity_score == _CHOSEN and left_out:
            self.calibrator_.score = choose_score(left_out, self.bins_.widths, self.calibrator_.alpha_per_target)
        if self.joint == "max":
            scored: list[Any] = [fit.first for fit in fits if fit.first is not None]
            scored = scored or self.proba_of(X)  # too few rows to leave any out
            self.calibrator_.fit_scale(scored, y[: len(scored[0])])

    def _labels(self, groups: npt.ArrayLike | None, n: int) -> AnyArray | None:
        """Labels (n,) of the samples' groups; None without groups."""
        self._check_grouped(groups)
        return None if groups is None else as_labels(groups, n)

    def _calibrate(
        self, features: Any, values: FloatArray, labels: AnyArray | None, units: AnyArray | None = None
    ) -> None:
        proba = self.proba_of(features)
        if isinstance(self.estimator, FrozenEstimator) and (told := self._doubt_seen(features, values)):
            warnings.warn(f"estimator: {told}", DataWarning, stacklevel=3)
        self.calibrator_.calibrate(proba, values, units if labels is None else labels)
        if labels is None:
            if np.isinf(self.calibrator_.thresholds_).any():
                n, beyond = self.calibrator_.n_units, int((self.bins_.encode(values) < 0).any(axis=1).sum())
                kind = "unit" if units is not None else "sample"
                why = f"{counted(n, f'calibration {kind} is', f'calibration {kind}s are')} too few"
                if self.calibrator_.rank <= n:
                    n = len(values)
                    why = f"{beyond} of {n} calibration samples have values beyond those learnt from, too many"
                warnings.warn(f"regions are unbounded: {why} for alpha = {self.calibrator_.alpha}", stacklevel=3)
            return
        small = {label: self.calibrator_.sizes_[label] for label in self.calibrator_.small_groups}
        if small:
            few = f"{counted(len(small), 'group')} with too few calibration samples"
            warnings.warn(f"regions of {few} are unbounded: {brief(small, 300)}", stacklevel=3)

    def _doubt_seen(self, features: Any, values: FloatArray) -> str:
        if not (is_frame(features) or isinstance(features, np.ndarray)) or hasattr(features, "with_columns"):
            return ""
        return doubt_seen(lambda X: PredictiveDensity(self.bins_, self.proba_of(X)).quantile(0.5), features, values)

    def _calibrated(self) -> Any:
        if not hasattr(self.calibrator_, "scores_"):
            raise not_calibrated("calibration_size is 0: call conformalize(X_cal, y_cal) first")
        return self.calibrator_

    def proba_of(self, features: Any) -> BinProbabilities:
        """Probabilities of the bins, of features that were checked."""
        return as_probabilities([predict_proba(model, features) for model in self.estimators_], self.bins_.sizes)

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        named = self.estimator is None or isinstance(self.estimator, str)
        tags.input_tags.allow_nan, tags.input_tags.sparse = named, False
        if hasattr(self.estimator, "__sklearn_tags__"):
            inner = get_tags(self.estimator).input_tags
            tags.input_tags.allow_nan, tags.input_tags.sparse = inner.allow_nan, inner.sparse
        return tags
