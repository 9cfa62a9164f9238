import numpy as np
import pytest
from PIL import Image

from conformodal.features import export as exporting
from conformodal.features.backbone import BackboneConfig, OnnxBackbone
from conformodal.features.export import exported, quantised
from conformodal.features.extract import FeatureCache
from conformodal.features.networks.torch_backbone import TorchBackbone
from conformodal.features.settings import VisionError

CONFIG = BackboneConfig(width=96, height=64, grid=(2, 3))


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return FeatureCache(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def backbone():
    return TorchBackbone(CONFIG)


@pytest.fixture(scope="module")
def onnx(backbone, cache):
    return exported(backbone, cache)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    rng, folder = np.random.default_rng(0), tmp_path_factory.mktemp("images")
    paths = [folder / f"{i}.png" for i in range(12)]
    for path in paths:
        small = Image.fromarray(rng.integers(0, 255, (8, 12, 3), dtype=np.uint8))
        small.resize((96, 64), Image.Resampling.BICUBIC).save(path)
    return paths


@pytest.fixture(scope="module")
def images(files):
    return np.stack([np.asarray(Image.open(path)) for path in files])


def test_the_exported_network_gives_torchs_features(backbone, onnx, images):
    expected = backbone.maps(images)
    np.testing.assert_allclose(onnx.maps(images), expected, atol=1e-5 * np.abs(expected).max())


def test_features_do_not_depend_on_the_other_images_of_a_batch(onnx, images):
    np.testing.assert_array_equal(onnx.maps(images), np.concatenate([onnx.maps(image[None]) for image in images]))
    np.testing.assert_array_equal(onnx.describe(images)[1:2].astype(np.float32), onnx.features_of(images[1]))


def test_an_export_that_answers_otherwise_is_refused(backbone, onnx, monkeypatch):
    other = TorchBackbone(CONFIG)
    for name, value in other.layers.named_parameters():
        if name.endswith("bias"):
            value.zero_()
    monkeypatch.setattr(exporting, "_export", lambda _: onnx.content)
    with pytest.raises(VisionError, match="answers otherwise"):
        exported(other, FeatureCache(None))


@pytest.mark.parametrize("content", [b"", b"no network", "half"])
def test_files_that_are_no_network_are_refused(onnx, content):
    with pytest.raises(VisionError, match="not an ONNX file"):
        OnnxBackbone(CONFIG, onnx.content[: len(onnx.content) // 2] if content == "half" else content)


def test_a_network_for_other_images_is_refused(onnx):
    with pytest.raises(VisionError, match=r"the input 'images' \(n, 48, 96, 3\)"):
        OnnxBackbone(BackboneConfig(width=96, height=48, grid=(2, 3)), onnx.content)


def test_eight_bits_are_smaller_and_near(onnx, files, images, tmp_path):
    cache = FeatureCache(tmp_path / "cache")
    small = quantised(onnx, files, cache)
    assert len(small.content) < 0.5 * len(onnx.content)
    assert small.fingerprint != onnx.fingerprint
    whole = onnx.maps(images)
    # 0.30 where the processor has no VNNI: sums of products of eight bits saturate there
    assert np.sqrt(np.mean((small.maps(images) - whole) ** 2)) < 0.4 * whole.std()


def test_a_network_is_quantised_once_for_the_same_images(onnx, files, tmp_path, monkeypatch):
    cache = FeatureCache(tmp_path / "cache")
    first = quantised(onnx, files, cache)
    monkeypatch.setattr(exporting, "_quantise", lambda *_: onnx.content)
    assert quantised(onnx, files, cache).content == first.content
    assert quantised(onnx, files[:5], cache).content == onnx.content  # other images: made anew
