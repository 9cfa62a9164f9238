"""Caches and states that are damaged, stopped, or shared: noticed, made again, and the same to the bit."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import save as save_tensors

from conformodal.core.files import locked
from conformodal.features.extract import FeatureCache, extract_features
from conformodal.features.heads import Head, fit_head, mean_squared_error, soft_cross_entropy
from conformodal.features.networks.torch_backbone import TorchBackbone, backbone_config
from conformodal.features.settings import TrainingConfig
from tests.io.test_layouts import write_sevenscenes


def flip(path: Path, at: float) -> None:
    content = bytearray(path.read_bytes())
    content[min(int(at * len(content)), len(content) - 1)] ^= 4
    path.write_bytes(bytes(content))


DAMAGE = {
    "empty": lambda p: p.write_bytes(b""),
    "cut in half": lambda p: p.write_bytes(p.read_bytes()[: p.stat().st_size // 2]),
    "last byte gone": lambda p: p.write_bytes(p.read_bytes()[:-1]),
    "bit in the middle": lambda p: flip(p, 0.5),
    "last bit": lambda p: flip(p, 1.0),
    "zeros": lambda p: p.write_bytes(bytes(p.stat().st_size)),
    "twice": lambda p: p.write_bytes(p.read_bytes() * 2),
    "other arrays": lambda p: p.write_bytes(save_tensors({"features": np.zeros(3, np.float16)})),
}


def toy():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(50, 12)).astype(np.float32)
    hot = np.eye(3, dtype=np.float32)[rng.integers(0, 3, (50, 2))].reshape(50, 6)
    return x, hot


def bits(head: Head) -> list[bytes]:
    return [value.numpy().tobytes() for value in head.state_dict().values()]


CONFIG = TrainingConfig(epochs=23, hidden=8, batch_size=16)


def trained(folder, stop_at=None, config=CONFIG):
    x, y = toy()

    def stop(done, _):
        if done == stop_at:
            raise KeyboardInterrupt

    return fit_head(x, y, [3, 3], soft_cross_entropy, config, checkpoint_dir=folder, progress=stop)


@pytest.fixture(scope="module")
def uninterrupted():
    return bits(trained(None))


@pytest.mark.parametrize("stops", [(1,), (9,), (10,), (11,), (22,), (12, 21)])
def test_a_training_taken_up_again_ends_as_the_uninterrupted_one(tmp_path, uninterrupted, stops):
    for stop_at in stops:
        with pytest.raises(KeyboardInterrupt):
            trained(tmp_path, stop_at)
    torch.rand(7)  # numbers that something else draws in between
    assert bits(trained(tmp_path)) == uninterrupted
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", ["empty", "bit in the middle", "other arrays"])
def test_a_damaged_state_is_dropped(tmp_path, uninterrupted, damage):
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, 12)
    (state,) = tmp_path.iterdir()
    DAMAGE[damage](state)
    assert bits(trained(tmp_path)) == uninterrupted


@pytest.mark.parametrize("other", ["outputs", "loss"])
def test_the_state_of_another_head_is_not_taken_up(tmp_path, other):
    x, y = toy()
    config = TrainingConfig(epochs=12, hidden=8)
    outputs, loss = ([2, 4], soft_cross_entropy) if other == "outputs" else ([3, 3], mean_squared_error)
    plain = bits(fit_head(x, y, outputs, loss, config))
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path, 11, config)
    assert bits(fit_head(x, y, outputs, loss, config, checkpoint_dir=tmp_path)) == plain


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
    "no vector": lambda path, expected: path.write_bytes(save_tensors({"other": expected.astype(np.float16)})),
    "longer": features_of(lambda vector: np.append(vector, 0)),
    "not finite": features_of(lambda vector: np.full_like(vector, np.nan)),
    "a folder": lambda path, _: (path.unlink(missing_ok=True), path.mkdir()),
}


@pytest.mark.parametrize("damage", VECTORS)
def test_a_damaged_vector_is_made_again(features, damage):
    files, backbone, folder, expected = features
    cache = FeatureCache(folder)
    key = cache.key(backbone, files[1])
    path = cache._path(key)
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
