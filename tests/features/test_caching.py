"""Cached features that are damaged are made again, the same to the bit; locks are held once."""

import os
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save as save_tensors

from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.networks.torch_backbone import TorchBackbone, backbone_config
from conformodal.io.folders import locked
from tests.io.test_layouts import write_sevenscenes


def flip(path: Path, at: float) -> None:
    content = bytearray(path.read_bytes())
    content[min(int(at * len(content)), len(content) - 1)] ^= 4
    path.write_bytes(bytes(content))


DAMAGE = {
    "empty": lambda p: p.write_bytes(b""),
    "cut in half": lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]),
    "bit in the middle": lambda p: flip(p, 0.5),
    "other arrays": lambda p: p.write_bytes(save_tensors({"features": np.zeros(3, np.float16)})),
}


@pytest.fixture(scope="module")
def features(tmp_path_factory):
    folder = tmp_path_factory.mktemp("features")
    files = sorted(write_sevenscenes(folder / "data").rglob("*.png"))[:3]
    backbone = TorchBackbone(backbone_config(64, 48))
    expected = extract_features(files, backbone, FeatureCache(folder))
    return files, backbone, folder, expected


def features_of(change):
    return lambda path, expected: path.write_bytes(save_tensors({"features": change(expected).astype(np.float16)}))


VECTORS = {
    **{name: lambda path, _, damage=damage: damage(path) for name, damage in DAMAGE.items()},
    "longer": features_of(lambda vector: np.append(vector, 0)),
    "not finite": features_of(lambda vector: np.full_like(vector, np.nan)),
    "a folder": lambda path, _: (path.unlink(missing_ok=True), path.mkdir()),
}


@pytest.mark.parametrize("damage", VECTORS)
def test_a_damaged_vector_is_made_again(features, damage):
    files, backbone, folder, expected = features
    cache = FeatureCache(folder)
    key = cache.key(backbone, files[1])
    path = folder / "features" / key[:2] / f"{key}.safetensors"
    VECTORS[damage](path, expected[1])
    assert cache.load(key) is None
    assert not path.is_file()
    if path.is_dir():
        path.rmdir()
    found = extract_features(files, backbone, FeatureCache(folder))
    # the image is in a batch of its own now, in which torch before 2.13 may round otherwise in half precision
    np.testing.assert_allclose(found, expected, rtol=2**-10)
    np.testing.assert_array_equal(found[[0, 2]], expected[[0, 2]])
    np.testing.assert_array_equal(cache.load(key), found[1].astype(np.float16))


@pytest.mark.parametrize("name", ["x", "a b", "é", "x" * 200])
def test_locks_are_held_once_and_leave_nothing(tmp_path, name):
    file = tmp_path / name
    with locked(file), locked(file):
        assert file.read_text() == f"{os.getpid()}\n"
    assert not file.exists()
    with locked(file):
        pass
