from pathlib import Path

import numpy as np
import pytest

from conformodal.networks import exporting
from conformodal.networks.exporting import exported
from conformodal.networks.torch_backbone import TorchBackbone
from conformodal.vision.backbone import BackboneConfig
from conformodal.vision.features import FeatureCache
from conformodal.vision.onnx_backbone import OnnxBackbone
from conformodal.vision.settings import VisionError

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
def images():
    return np.random.default_rng(1).integers(0, 256, (3, 64, 96, 3), dtype=np.uint8)


def test_the_exported_network_gives_torchs_features(backbone, onnx, images):
    expected = backbone.maps(images)
    np.testing.assert_allclose(onnx.maps(images), expected, atol=1e-5 * np.abs(expected).max())


def test_features_do_not_depend_on_the_other_images_of_a_batch(onnx, images):
    np.testing.assert_array_equal(onnx.maps(images), np.concatenate([onnx.maps(image[None]) for image in images]))
    np.testing.assert_array_equal(onnx.describe(images)[1:2].astype(np.float32), onnx.features_of(images[1]))


def test_a_network_is_exported_once(backbone, onnx, cache, monkeypatch):
    monkeypatch.setattr(exporting, "_export", lambda _: pytest.fail("exported again"))
    again = exported(backbone, cache)
    assert again.content == onnx.content
    assert again.fingerprint == onnx.fingerprint != backbone.fingerprint


def test_the_file_names_no_source_of_this_machine(onnx):
    assert b".py" not in onnx.content


def test_the_oldest_runtime_reads_the_file(backbone):
    import onnx

    model = onnx.load_model_from_string(exporting._export(backbone))
    assert model.ir_version == 10  # the newest of ONNX Runtime 1.20
    assert {one.domain: one.version for one in model.opset_import if one.version}[""] == 18
    assert '"onnxruntime>=1.20"' in (Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8")


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
    with pytest.raises(VisionError, match="no ONNX file"):
        OnnxBackbone(CONFIG, onnx.content[: len(onnx.content) // 2] if content == "half" else content)


def test_a_network_for_other_images_is_refused(onnx):
    with pytest.raises(VisionError, match=r"the input 'images' \(n, 48, 96, 3\)"):
        OnnxBackbone(BackboneConfig(width=96, height=48, grid=(2, 3)), onnx.content)
