"""Heads on features: a projection, one hidden layer and one output block per target; their losses and training."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import cos, pi
from typing import NamedTuple, Self, TypeAlias

import numpy as np
from scipy.linalg import eigh
from scipy.special import erf, softmax

from conformodal.core.arrays import AnyArray, Float32Array, FloatArray, RealArray
from conformodal.core.parallel import one_blas_thread, raise_if_cancelled
from conformodal.core.progress import Progress

from .settings import TrainingConfig, VisionError

_ROWS, _COLUMNS = 256, 2048  # samples, and features, of which copies are made at a time
_EPSILON = np.float32(1e-5)  # of the layer norm
_MAX_ROUNDED = 1e-3  # error of an entry of a standardised direction by half precision, as a share of its largest one
_LAYERS = "hidden.weight", "hidden.bias", "norm.weight", "norm.bias", "output.weight", "output.bias"


@dataclass(frozen=True, eq=False)
class Projection:
    """A linear map of features to their principal components, learnt without targets."""

    offset: Float32Array  # (F,) mean of the training features
    components: Float32Array  # (F, k) scaled directions, or (F,) scales that keep every feature

    @property
    def size(self) -> int:
        """How many components there are, k."""
        return int(self.components.shape[-1])

    @classmethod
    def from_arrays(cls, offset: Float32Array, components: AnyArray) -> Self:
        """The projection that was stored."""
        return cls(offset, components.astype(np.float32))

    def arrays(self) -> dict[str, AnyArray]:
        """Offset and components, to be stored: in half precision where that loses nothing."""
        with np.errstate(over="ignore"):
            half = self.components.astype(np.float16)
        return {"offset": self.offset, "components": half if (half == self.components).all() else self.components}

    def apply(self, features: Float32Array) -> Float32Array:
        """Projected features (n, k) of features (n, F)."""
        return np.concatenate([self._apply(features[rows]) for rows in _blocks(max(len(features), 1), _ROWS)])

    def _apply(self, features: Float32Array) -> Float32Array:
        centred = features - self.offset
        projected = centred @ self.components if self.components.ndim == 2 else centred * self.components
        return np.asarray(projected, dtype=np.float32)


def _blocks(n: int, size: int) -> Iterator[slice]:
    """Slices of so many numbers that cover n."""
    return (slice(start, min(start + size, n)) for start in range(0, n, size))


def fit_projection(features: Float32Array, n_components: int | None, view: slice = slice(None)) -> Projection:
    """Principal components of standardised features (n, F), scaled together to a mean variance of one.

    They are not whitened, so that a network and dropout see how much each matters. They make training faster.
    At most n - 1 and F are computed; None keeps all features. Those that are not in the `view` get weight zero.
    """
    offset = features.mean(axis=0)
    if view != slice(None):
        part = fit_projection(features[:, view], n_components)
        components = np.zeros((features.shape[1], *part.components.shape[1:]), dtype=np.float32)
        components[view] = part.components
        return Projection(offset, components)
    n, n_features = features.shape
    # features that hardly vary (dead ReLU6 outputs) must not blow up when they do
    spreads = [features[:, part].std(axis=0) for part in _blocks(n_features, _COLUMNS)]
    scale = np.asarray(np.concatenate(spreads) + 1e-3, dtype=np.float32)
    # features that are all the same have no directions, even where their rounded mean differs from them
    if n_components is None or not np.ptp(features, axis=0).any():
        return Projection(offset, np.asarray(1 / scale, dtype=np.float32))
    directions, variances = _principal_components(features, offset, scale, min(n_components, n - 1, n_features))
    directions /= np.sqrt(max(float(variances.mean()), 1e-12))
    return Projection(offset, _rounded(np.ascontiguousarray(directions.T, dtype=np.float32), scale))


def _rounded(directions: Float32Array, scale: Float32Array) -> Float32Array:
    """Standardised directions (F, k) over the features' scale (F,), in half precision unless that changes them much.

    Components are the largest arrays of a model but for its map.
    """
    components = directions / scale[:, None]
    with np.errstate(over="ignore"):
        half = components.astype(np.float16).astype(np.float32)
    off = np.abs((half - components) * scale[:, None]).max(axis=0)
    return half if (off <= _MAX_ROUNDED * np.abs(directions).max(axis=0)).all() else components


def _principal_components(
    features: Float32Array, offset: Float32Array, scale: Float32Array, k: int
) -> tuple[FloatArray, FloatArray]:
    """The first k directions (k, F) of standardised features (n, F), and the variances (k,) along them, largest first.

    Exact, as the last of a few hundred directions are where a randomised solver is poor; by the eigenvectors of n x n
    products where there are fewer samples than features, in a fifth of the time of a singular value decomposition.
    Products are summed over some features, or samples, at a time: copies of all would be what training needs most
    memory for. scikit-learn takes a second and 80 MB to import, in each process of a training.
    """
    n, n_features = features.shape

    def centred(part: slice) -> FloatArray:
        standardised = ((features[:, part] - offset[part]) / scale[part]).astype(np.float64)
        standardised -= standardised.mean(axis=0)
        return standardised

    def largest_eigenvectors(products: FloatArray) -> tuple[FloatArray, FloatArray]:
        squares, vectors = eigh(products, subset_by_index=[len(products) - k, len(products) - 1])
        return np.maximum(squares[::-1], 0), vectors[:, ::-1]

    if n > n_features:
        products, total = np.zeros((n_features, n_features)), np.zeros(n_features)
        for part in _blocks(n, _COLUMNS):
            samples = ((features[part] - offset) / scale).astype(np.float64)
            products += samples.T @ samples
            total += samples.sum(axis=0)
        squares, vectors = largest_eigenvectors(products - np.outer(total, total) / n)
        directions = vectors.T
    else:
        products = np.zeros((n, n))
        for part in _blocks(n_features, _COLUMNS):
            columns = centred(part)
            products += columns @ columns.T
        squares, vectors = largest_eigenvectors(products)
        lengths = np.sqrt(squares)
        lengths[squares <= n * np.finfo(np.float64).eps * squares[0]] = np.inf  # samples that repeat have no directions
        directions = np.empty((k, n_features))
        for part in _blocks(n_features, _COLUMNS):
            directions[:, part] = vectors.T @ centred(part) / lengths[:, None]
    largest = directions[np.arange(k), np.abs(directions).argmax(axis=1)]
    directions *= np.sign(largest)[:, None]  # the sign is arbitrary
    return directions, squares / (n - 1)


@dataclass(frozen=True, eq=False)
class Head:
    """Projected features, one hidden layer with layer norm and GELU, and a linear output per target."""

    weights: Mapping[str, Float32Array]  # offset and components of the projection, and those of the layers
    outputs: Sequence[int]  # numbers per target: the bins of a softmax, or one

    @property
    def hidden(self) -> int:
        """Units of the hidden layer."""
        return int(self.weights["output.weight"].shape[1])

    @property
    def projection(self) -> Projection:
        """The projection of features that the head was trained behind."""
        return Projection(self.weights["offset"], self.weights["components"])

    @property
    def n_trained(self) -> int:
        """Numbers that were trained."""
        return sum(self.weights[name].size for name in _LAYERS)

    def predict(self, features: Float32Array) -> FloatArray:
        """Raw outputs (n, sum of outputs) of features (n, F)."""
        projected = self.projection.apply(features)
        return _forward(self.weights, projected, None, None).raw.astype(np.float64)

    def predict_proba(self, features: Float32Array) -> list[RealArray]:
        """Softmax of every target: d arrays (n, K_j), float64 so that rows sum to one closely."""
        cuts = np.cumsum(self.outputs)[:-1]
        return [softmax(block, axis=1) for block in np.split(self.predict(features), cuts, axis=1)]


class _Passed(NamedTuple):
    """What a batch (n, k) gave on its way through the layers; gradients need it."""

    x: Float32Array  # without what was dropped
    unit: Float32Array  # (n, hidden) normalised
    scale: Float32Array  # (n, 1) by which
    normed: Float32Array  # (n, hidden) after the layer norm
    below: Float32Array  # (n, hidden) standard normal distribution function of these
    active: Float32Array  # (n, hidden) without what was dropped
    kept: Float32Array | None  # (n, hidden) factor of each unit: 0 where it was dropped
    raw: Float32Array  # (n, sum of outputs)


def _forward(
    weights: Mapping[str, Float32Array], x: Float32Array, kept_inputs: Float32Array | None, kept: Float32Array | None
) -> _Passed:
    """Through the layers; the factors, in training, drop inputs and hidden units."""
    x = x if kept_inputs is None else x * kept_inputs
    unit = x @ weights["hidden.weight"].T + weights["hidden.bias"]
    unit -= unit.mean(axis=1, keepdims=True)
    scale = 1 / np.sqrt(np.square(unit).mean(axis=1, keepdims=True) + _EPSILON)
    unit *= scale
    normed = unit * weights["norm.weight"] + weights["norm.bias"]
    below = np.float32(0.5) * (1 + erf(normed * np.float32(np.sqrt(0.5))))
    active = normed * below if kept is None else normed * below * kept
    raw = np.asarray(active @ weights["output.weight"].T + weights["output.bias"], dtype=np.float32)
    return _Passed(x, unit, scale, normed, below, active, kept, raw)


def _backward(
    weights: Mapping[str, Float32Array], gradient: Mapping[str, Float32Array], passed: _Passed, by_raw: RealArray
) -> None:
    """Write the gradient by all weights, from that by the raw outputs."""
    slope = by_raw.astype(np.float32, copy=False)
    np.matmul(slope.T, passed.active, out=gradient["output.weight"])
    np.sum(slope, axis=0, out=gradient["output.bias"])
    slope = slope @ weights["output.weight"]
    if passed.kept is not None:
        slope *= passed.kept
    density = np.exp(np.float32(-0.5) * np.square(passed.normed)) * np.float32(1 / np.sqrt(2 * np.pi))
    slope *= passed.below + passed.normed * density
    np.sum(slope * passed.unit, axis=0, out=gradient["norm.weight"])
    np.sum(slope, axis=0, out=gradient["norm.bias"])
    slope *= weights["norm.weight"]
    along = (slope * passed.unit).mean(axis=1, keepdims=True)
    slope = passed.scale * (slope - slope.mean(axis=1, keepdims=True) - passed.unit * along)
    np.matmul(slope.T, passed.x, out=gradient["hidden.weight"])
    np.sum(slope, axis=0, out=gradient["hidden.bias"])


# ---- losses: gradients by the raw outputs (n, sum of outputs) of a batch, from these, targets and numbers per target

Loss: TypeAlias = Callable[[Float32Array, Float32Array, Sequence[int]], RealArray]


def soft_cross_entropy(raw: Float32Array, targets: Float32Array, outputs: Sequence[int]) -> RealArray:
    """Mean over targets of the cross-entropy with order-aware labels; `targets` is (n, sum of K_j)."""
    if len(set(outputs)) == 1:  # one call for all targets is quicker than seven
        proba = softmax(raw.reshape(-1, outputs[0]), axis=1).reshape(raw.shape)
    else:
        cuts = np.cumsum(outputs)[:-1]
        proba = np.concatenate([softmax(block, axis=1) for block in np.split(raw, cuts, axis=1)], axis=1)
    return np.asarray((proba - targets) / (len(raw) * len(outputs)))


def mean_squared_error(raw: Float32Array, targets: Float32Array, outputs: Sequence[int]) -> RealArray:
    """The classical regressor's loss, on standardised targets (n, d)."""
    return np.asarray(2 * (raw - targets) / targets.size)


# ---- training

# of AdamW (Loshchilov and Hutter 2019), and of one cycle of rate and momentum (Smith and Topin 2019)
_SECOND_MOMENT, _ADAM_EPSILON = 0.999, 1e-8
_RISE, _MOMENTUM = 0.1, (0.95, 0.85)  # share of the steps; momentum at the ends of the cycle and at its peak
_FIRST_RATE, _LAST_RATE = 1 / 25, 1 / 25e4  # as shares of the greatest


def fit_head(
    features: Float32Array,
    targets: RealArray,
    outputs: Sequence[int],
    loss: Loss,
    config: TrainingConfig,
    *,
    projection: Projection | None = None,
    progress: Progress | None = None,
) -> Head:
    """Train a head on features (n, F) and targets (n, p), in the form that the loss takes.

    `projection` is that of these features, by default fitted; heads of the same samples can share one. It is not
    trained. The result is the same on any number of cores.
    """
    x, y = (np.ascontiguousarray(array, dtype=np.float32) for array in (features, targets))
    if len(x) < 2 or len(x) != len(y):
        raise VisionError(f"training needs two samples or more, as many as targets; got {x.shape}, {y.shape}")
    through = fit_projection(x, config.components) if projection is None else projection
    projected, rng = through.apply(x), np.random.default_rng(config.seed)
    with one_blas_thread():  # a batch is too small to share
        layers = _Layers.drawn(through.size, config.hidden, sum(outputs), rng)
        _train(layers, projected, y, lambda raw, labels: loss(raw, labels, outputs), config, rng, progress)
    return Head({"offset": through.offset, "components": through.components, **layers.by_name}, list(outputs))


class _Layers:
    """Numbers of the layers in one array, which the optimiser takes at once, with a view of each layer's."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]]) -> None:
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])
        self.flat: Float32Array = np.zeros(ends[-1], dtype=np.float32)
        parts = np.split(self.flat, ends[:-1])
        self.by_name = {name: part.reshape(shapes[name]) for name, part in zip(shapes, parts, strict=True)}

    @classmethod
    def drawn(cls, inputs: int, hidden: int, outputs: int, rng: np.random.Generator) -> Self:
        """Linear layers even within one over the root of their inputs; the norm changes nothing."""
        shapes = (hidden, inputs), (hidden,), (hidden,), (hidden,), (outputs, hidden), (outputs,)
        layers = cls(dict(zip(_LAYERS, shapes, strict=True)))
        for name, fan_in in (("hidden", inputs), ("output", hidden)):
            for part in ("weight", "bias"):
                values = layers.by_name[f"{name}.{part}"]
                values[...] = rng.uniform(-1, 1, values.shape) / np.sqrt(fan_in)
        layers.by_name["norm.weight"][...] = 1
        return layers


def _train(
    layers: _Layers,
    x: Float32Array,
    y: Float32Array,
    loss: Callable[[Float32Array, Float32Array], RealArray],
    config: TrainingConfig,
    rng: np.random.Generator,
    progress: Progress | None,
) -> None:
    """Fit layers in place to projected samples (n, k) and targets, by AdamW."""
    input_dropout = config.dropout if config.input_dropout is None else config.input_dropout
    size = min(config.batch_size, len(x))
    gradient = _Layers({name: values.shape for name, values in layers.by_name.items()})
    first, second, scratch = (np.zeros_like(layers.flat) for _ in range(3))
    first_left, second_left = 1.0, 1.0  # of what the moments started from
    step, n_steps = 0, config.epochs * -(-len(x) // size)
    for epoch in range(config.epochs):
        raise_if_cancelled()
        order = np.random.default_rng((config.seed, epoch)).permutation(len(x))
        for rows in np.split(order, np.arange(size, len(x), size)):
            kept_inputs = _kept((len(rows), x.shape[1]), input_dropout, rng)
            kept = _kept((len(rows), config.hidden), config.dropout, rng)
            passed = _forward(layers.by_name, x[rows], kept_inputs, kept)
            _backward(layers.by_name, gradient.by_name, passed, loss(passed.raw, y[rows]))
            rate, momentum = _one_cycle(step, n_steps)
            rate *= config.learning_rate
            step += 1
            first_left, second_left = first_left * momentum, second_left * _SECOND_MOMENT
            layers.flat *= 1 - rate * config.weight_decay
            first += np.multiply(gradient.flat - first, 1 - momentum, out=scratch)
            np.multiply(gradient.flat, gradient.flat, out=scratch)
            scratch -= second
            scratch *= 1 - _SECOND_MOMENT
            second += scratch
            np.sqrt(second, out=scratch)
            scratch /= np.sqrt(1 - second_left)
            scratch += _ADAM_EPSILON
            np.divide(first, scratch, out=scratch)
            scratch *= rate / (1 - first_left)
            layers.flat -= scratch
        if progress is not None:
            progress(epoch + 1, config.epochs)


def _kept(shape: tuple[int, int], share: float, rng: np.random.Generator) -> Float32Array | None:
    """Factors that drop a share of numbers and keep their mean; None where none is dropped."""
    if share == 0:
        return None
    return (rng.random(shape, dtype=np.float32) >= share) * np.float32(1 / (1 - share))


def _one_cycle(step: int, n_steps: int) -> tuple[float, float]:
    """Share of the greatest rate, and momentum: a short rise and a long fall, each along a cosine."""
    peak, low, high = _RISE * n_steps - 1, *_MOMENTUM
    if step < peak:
        return _cosine(_FIRST_RATE, 1.0, step / peak), _cosine(low, high, step / peak)
    fallen = (step - peak) / (n_steps - 1 - peak)
    return _cosine(1.0, _LAST_RATE, fallen), _cosine(high, low, fallen)


def _cosine(start: float, end: float, share: float) -> float:
    return end + (start - end) / 2 * (1 + cos(pi * share))
