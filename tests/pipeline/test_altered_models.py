"""Whoever alters a saved model, digests and all, gets an error that names what does not fit, or an answer."""

import hashlib
import json
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from safetensors.numpy import load, save

from conformodal.conformal import ConformodalError
from conformodal.features.networks import make_detector
from conformodal.pipeline.estimator import VisualOdometry
from conformodal.pipeline.store import ModelFileError, _digest, load_model, save_model
from tests.helpers import LFS_POINTER
from tests.small_model import CAMERA, image, small_model


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The folder of a saved model with few cells, its record and its arrays."""
    folder = tmp_path_factory.mktemp("small")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("conformodal.localizer.cells._CELLS", 40)
        patch.setattr("conformodal.localizer.cells.BEYOND", 10)
        save_model(small_model(), folder)
        record = json.loads((folder / "model.json").read_text())
        yield folder, record, load((folder / f"weights-{record['weights'][:8]}.safetensors").read_bytes())


def fate(folder, record, name):
    """What an altered model does wrong; empty where it is refused by name, or answers."""
    record = {k: v for k, v in record.items() if k != "sha256"}
    (folder / "model.json").write_text(json.dumps({**record, "sha256": _digest(record)}))
    try:
        model = load_model(folder)
    except ModelFileError as exc:
        return "" if name in str(exc) else f"the error does not name it: {exc}"
    except Exception as exc:
        return f"loading raises {exc!r}"
    try:
        VisualOdometry(model).step(image(), 1.0)
    except ConformodalError:
        pass
    except Exception as exc:
        return f"a step raises {exc!r}"
    return ""


def write_arrays(folder, arrays):
    content = save(arrays)
    digest = hashlib.sha256(content).hexdigest()
    (folder / f"weights-{digest[:8]}.safetensors").write_bytes(content)
    return digest


def altered_arrays(array):
    """The same array, altered."""
    rng, first = np.random.default_rng(0), (0,) * array.ndim
    yield "shorter", array[:-1]
    yield "deeper", array[..., None]
    yield "empty", array[:0]
    yield "shuffled", rng.permutation(array.reshape(-1)).reshape(array.shape)
    yield "of other numbers", array.astype(np.float32 if array.dtype.kind in "iub" else np.int64)
    if array.dtype.kind == "i":
        for value in (-1, 2**40, np.iinfo(array.dtype).max):
            changed = array.copy()
            changed[-1] = value
            yield f"with {value}", changed
    if array.dtype.kind == "f":
        yield "negative", -array
        yield "of zeros", np.zeros_like(array)
        for value in (np.nan, np.inf, np.finfo(array.dtype).max):
            changed = array.copy()
            changed[first] = value
            yield f"with {value}", changed


def test_altered_arrays_are_refused_by_name_or_answer(saved):
    folder, record, arrays = saved
    wrong = []
    for name, array in arrays.items():
        for what, altered in altered_arrays(array):
            if np.array_equal(altered, array, equal_nan=array.dtype.kind == "f") and altered.dtype == array.dtype:
                continue
            digest = write_arrays(folder, {**arrays, name: np.ascontiguousarray(altered)})
            part = name.split(".", 2)[2] if name.startswith("source.") else name
            part = "bins" if part.startswith("bins.") else part  # sources are asked for as many
            if problem := fate(folder, {**record, "weights": digest}, part):
                wrong.append(f"{name} {what}: {problem}")
            (folder / f"weights-{digest[:8]}.safetensors").unlink()
    assert not wrong, "\n".join(wrong)


def values_in(value, path=()):
    """The paths of all values in a record."""
    yield path
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in entries:
        yield from values_in(entry, (*path, key))


def test_altered_json_is_refused_by_name_or_answers(saved):
    folder, record, _ = saved
    wrong = []
    for path, key in [
        (p[:-1], p[-1]) for p in values_in({k: v for k, v in record.items() if k not in ("format", "sha256")}) if p
    ]:
        for value in ("text", 7, -1, 1e300, 10**30, None, [], {}):
            changed = deepcopy(record)
            parent = changed
            for step in path:
                parent = parent[step]
            parent[key] = value
            if problem := fate(folder, changed, (*path, key)[0]):
                wrong.append(f"{'.'.join(map(str, (*path, key)))} = {value}: {problem}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ["bins.6", "frames.poses", "calibration.loc", "path.online.units", "matched.units"])
def test_a_missing_array_is_named(saved, name):
    folder, record, arrays = saved
    digest = write_arrays(folder, {k: v for k, v in arrays.items() if k != name})
    assert fate(folder, {**record, "weights": digest}, name) == ""
    with pytest.raises(ModelFileError, match=name):
        load_model(folder)


def edit_json(change):
    def spoil(folder):
        path = folder / "model.json"
        record = json.loads(path.read_text())
        change(record)
        path.write_text(json.dumps(record))

    return spoil


def file_of(folder, kind):
    (path,) = folder.glob(f"{kind}-*")
    return path


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    path.write_bytes(bytes(content))


SPOILT = {
    "a bit of the weights": (lambda f: flip_a_bit(file_of(f, "weights")), r"weights-.*digest differs"),
    "a bit of the network": (lambda f: flip_a_bit(file_of(f, "network")), r"network-.*digest differs"),
    "alpha": (edit_json(lambda r: r["calibration"].update(alpha="0.5")), r"model\.json.*altered"),
    "a newer format": (edit_json(lambda r: r.update(format="conformodal-model-99999")), "update conformodal"),
    "weights that are a pointer of Git LFS": (
        lambda f: file_of(f, "weights").write_bytes(LFS_POINTER),
        r"weights-.*pointer of Git LFS.*git lfs pull",
    ),
    "an older format": (edit_json(lambda r: r.update(format="conformodal-model-19")), "Train the model again"),
    "half of the JSON": (lambda f: (f / "model.json").write_text("{"), r"model\.json"),
    "a list": (lambda f: (f / "model.json").write_text("[]"), r"model\.json.*list"),
    "no JSON": (lambda f: (f / "model.json").unlink(), r"model\.json"),
    "no weights": (lambda f: file_of(f, "weights").unlink(), r"weights-.*cannot be read"),
    "no network": (lambda f: file_of(f, "network").unlink(), r"network-.*cannot be read"),
}


def test_a_model_with_xfeat_answers_as_before_it_was_saved(tmp_path):
    detector = make_detector("xfeat", CAMERA)
    model = small_model(detector)
    save_model(model, tmp_path)
    first, again = (VisualOdometry(one).step(image(), 1.0) for one in (model, load_model(tmp_path)))
    assert first.pose is not None
    assert again.pose is not None
    np.testing.assert_array_equal(first.pose.pose_se3, again.pose.pose_se3)
    record = json.loads((tmp_path / "model.json").read_text())
    record["detector"] = hashlib.sha256(b"").hexdigest()
    (tmp_path / f"detector-{record['detector'][:8]}.zip").write_bytes(b"")
    record["configuration"]["features"] = "orb"
    assert fate(tmp_path, record, "not described by the local features 'orb'") == ""


@pytest.mark.parametrize("what", SPOILT)
def test_a_damaged_model_is_refused(tmp_path, what):
    spoil, match = SPOILT[what]
    save_model(small_model(), tmp_path)
    spoil(tmp_path)
    with pytest.raises(ModelFileError, match=match):
        load_model(tmp_path)


def test_a_model_that_could_not_be_read_back_is_not_saved(tmp_path):
    model = small_model()
    model.prior = replace(model.prior, volume_m3=7.8e9)  # of a world in millimetres
    save_model(model, tmp_path)
    assert load_model(tmp_path).prior.volume_m3 == 7.8e9
    before = (tmp_path / "model.json").read_bytes()
    model.rules = replace(model.rules, known_p=model.rules.known_p + 1)
    with pytest.raises(ModelFileError, match="known_p"):
        save_model(model, tmp_path)
    assert (tmp_path / "model.json").read_bytes() == before
    load_model(tmp_path)
