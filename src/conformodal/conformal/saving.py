"""Fitted regressors as files of skops, which hold data and the names of types, never code."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import sklearn

from conformodal.core.errors import ConformodalError
from conformodal.core.extras import require_extra
from conformodal.core.files import read_file, replacing

from .checks import brief

_KIND = "conformodal-table-"
_FORMAT = f"{_KIND}5"  # 4 did not know what its training rows held
_PACKAGE = "conformodal.conformal."
# what skops does not trust by itself: labels of groups, exact rates, compiled trees, kernels, and sparse arrays, of
# which it knows matrices
_FOREIGN = (
    "datetime.datetime", "datetime.timezone", "decimal.Decimal", "fractions.Fraction",
    "scipy.sparse._csr.csr_array", "sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor",
    *(f"sklearn.gaussian_process.kernels.{name}" for name in ("ConstantKernel", "Matern", "Product", "Sum")),
    "sklearn.gaussian_process.kernels.WhiteKernel", "sklearn.metrics._dist_metrics.EuclideanDistance64",
    "sklearn.neighbors._kd_tree.KDTree", "sklearn.neural_network._stochastic_optimizers.AdamOptimizer",
    "sklearn.tree._tree.Tree", "sklearn.utils._bunch.Bunch",
)  # fmt: skip


def check_replaceable(path: str | Path) -> None:
    """Refuse a folder, and a file with anything but a saved regressor in it."""
    path = Path(path)
    replaceable = not path.exists() or (path.is_file() and path.stat().st_size == 0)
    if zipfile.is_zipfile(path):
        with suppress(Exception), zipfile.ZipFile(path) as archive:  # whatever another file leads to
            replaceable = _KIND.encode() in archive.read("schema.json")
    if not replaceable:
        raise ConformodalError(f"{path}: exists and is not a saved regressor, not replaced; name another file")


def save_regressor(regressor: Any, path: str | Path) -> None:
    """Write a regressor into a file, whole or not at all."""
    check_replaceable(path)
    with require_extra("save", "saving a regressor"):
        import skops.io  # noqa: PLC0415
    record = {"format": _FORMAT, "scikit-learn": sklearn.__version__, "regressor": regressor}
    try:
        content = skops.io.dumps(record, compression=zipfile.ZIP_DEFLATED)
    except Exception as exc:  # whatever a foreign class raises
        raise ConformodalError(f"{path}: estimator cannot be saved: {brief(exc, 300)}") from exc
    with replacing(Path(path)) as part:
        part.write_bytes(content)


def load_regressor(path: str | Path, trusted: Sequence[str]) -> Any:
    """Read a regressor back; `trusted` are types that may be made beside those of the named learners.

    Types are checked, the arrays of compiled trees are not: a file that was altered on purpose can crash Python.
    """
    with require_extra("save", "loading a regressor"):
        import skops.io  # noqa: PLC0415
    try:
        content = read_file(path)
        types = skops.io.get_untrusted_types(data=content)
    except OSError as exc:
        raise ConformodalError(f"{path}: cannot be read: {exc.strerror}") from None
    except Exception as exc:  # whatever a damaged file leads to
        raise ConformodalError(f"{path}: is not a saved regressor: {type(exc).__name__}") from exc
    unknown = [name for name in types if not name.startswith(_PACKAGE) and name not in (*_FOREIGN, *trusted)]
    if unknown:
        raise ConformodalError(f"{path}: holds the types {', '.join(unknown)}; if you trust them: load(trusted=[...])")
    try:
        record = skops.io.loads(content, trusted=types)
        regressor, version = record["regressor"], record["scikit-learn"]
        if record["format"] != _FORMAT:
            raise ValueError(f"got {brief(record['format'])}, fit and save it again")
    except Exception as exc:  # whatever a damaged file leads to
        raise ConformodalError(f"{path}: is not a complete {_FORMAT}: {type(exc).__name__}: {brief(exc)}") from exc
    if version != sklearn.__version__:
        versions = f"saved with scikit-learn {version}, loaded with {sklearn.__version__}"
        warnings.warn(f"{path}: {versions}: check its predictions", stacklevel=3)
    return regressor
