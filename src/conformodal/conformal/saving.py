"""Fitted regressors as files of skops, which hold data and the names of types, never code."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import sklearn

from conformodal.core.errors import ConformodalError
from conformodal.core.extras import require_extra
from conformodal.core.files import foreign_kind, read_file, remove_leftovers, write_whole
from conformodal.core.words import describe_format

from .checks import brief

_KIND = "conformodal-table-"
_FORMAT = f"{_KIND}6"  # 5 did not know parts of dates
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

# bytes that a file may unpack to, and its schema, of which Python makes 20 times as much: in all, and times its size
_MIN_BYTES, _MAX_BYTES, _TIMES = 2**26, 2**32, 100
_MIN_SCHEMA_BYTES, _SCHEMA_TIMES = 2**24, 20


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
        content = skops.io.dumps(record, compression=zipfile.ZIP_DEFLATED, compresslevel=1)
        try:
            _unpacked(content)
        except ValueError:  # arrays of one value, which shrink more than is loaded
            _unpacked(content := skops.io.dumps(record))
    except Exception as exc:  # whatever a foreign class raises
        raise ConformodalError(f"{path}: estimator cannot be saved: {brief(exc, 300)}") from exc
    remove_leftovers(Path(path))
    write_whole(Path(path), content)


def load_regressor(path: str | Path, trusted: Sequence[str]) -> Any:
    """Read a regressor back; `trusted` are types that may be made beside those of the named learners.

    Types are checked, the arrays of compiled trees are not: a file that was altered on purpose can crash Python.
    """
    with require_extra("save", "loading a regressor"):
        import skops.io  # noqa: PLC0415
    try:
        content = read_file(path)
        content = _unpacked(content)
        types = skops.io.get_untrusted_types(data=content)
    except OSError as exc:
        raise ConformodalError(f"{path}: cannot be read: {exc.strerror}") from None
    except Exception as exc:  # whatever a damaged file leads to
        what = f"{type(exc).__name__}: {brief(exc, 200)}"
        if isinstance(exc, KeyError) and "schema.json" in str(exc):  # an archive of something else
            what = foreign_kind(content) or what
        raise ConformodalError(f"{path}: is not a saved regressor: {what}") from exc
    unknown = [name for name in types if not name.startswith(_PACKAGE) and name not in (*_FOREIGN, *trusted)]
    if unknown:
        raise ConformodalError(f"{path}: holds the types {', '.join(unknown)}; if you trust them: load(trusted=[...])")
    try:
        record = skops.io.loads(content, trusted=types)
        regressor, version = record["regressor"], record["scikit-learn"]
        if record["format"] != _FORMAT:
            raise ValueError(describe_format(record["format"], _FORMAT, "fit and save it again"))
    except Exception as exc:  # whatever a damaged file leads to
        raise ConformodalError(f"{path}: is not a complete {_FORMAT}: {type(exc).__name__}: {brief(exc, 300)}") from exc
    if version != sklearn.__version__:
        versions = f"saved with scikit-learn {version}, loaded with {sklearn.__version__}"
        warnings.warn(f"{path}: {versions}: check its predictions", stacklevel=3)
    return regressor


def _unpacked(content: bytes) -> bytes:
    """The same archive without compression; refused if it unpacks to more than a saved regressor can.

    Archives in it, which hold sparse arrays, count by what they unpack to; entries, as often as they are read.
    """
    room, out = min(max(_TIMES * len(content), _MIN_BYTES), _MAX_BYTES), io.BytesIO()
    readers: set[Any] = set()  # names of entries, and the objects that each is read for
    with zipfile.ZipFile(io.BytesIO(content)) as archive, zipfile.ZipFile(out, "w") as plain:
        room -= _checked_size(archive, room)
        if archive.getinfo("schema.json").file_size > max(_SCHEMA_TIMES * len(content), _MIN_SCHEMA_BYTES):
            raise ValueError("schema.json unpacks to more than a saved regressor needs")
        for entry in archive.infolist():
            with archive.open(entry) as file:
                part = file.read(entry.file_size)  # inflates no more than that, whatever there is
            if zipfile.is_zipfile(io.BytesIO(part)):
                with zipfile.ZipFile(io.BytesIO(part)) as inner:
                    room -= _checked_size(inner, room)
            if entry.filename == "schema.json":
                json.loads(part, object_hook=lambda node: readers.add((node.get("file"), node.get("__id__"))))
            plain.writestr(entry.filename, part)
        if sum(archive.getinfo(name).file_size for name, _ in readers if name) > max(room, out.tell()):
            raise ValueError("its entries are read again and again")
    return out.getvalue()


def _checked_size(archive: zipfile.ZipFile, room: int) -> int:
    """What all entries unpack to by their own account, which must be at most `room`."""
    entries = archive.infolist()
    size, names = sum(entry.file_size for entry in entries), {entry.filename for entry in entries}
    if size > room:
        raise ValueError(f"unpacks to {size >> 20} MB, more than a saved regressor can")
    for entry in entries:
        if entry.file_size == 0 or set("/\\") & set(entry.filename):
            raise ValueError(f"entry {brief(entry.filename)} is empty or in a folder")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"entry {brief(entry.filename)} is neither stored nor deflated")
    if len(names) < len(entries):
        raise ValueError("two entries have one name")
    return size
