from dataclasses import replace

import numpy as np
import pytest

from conformodal.features import export as exporting
from conformodal.features.backbone import Backbone
from conformodal.features.export import export_backbone
from conformodal.features.extract import FeatureCache
from conformodal.features.settings import VisionError

IMAGES = np.random.default_rng(0).integers(0, 255, (5, 64, 96, 3), dtype=np.uint8)


def test_the_exported_network_gives_torchs_features(network, backbone):
    expected = network.maps(IMAGES)
    np.testing.assert_allclose(backbone.maps(IMAGES), expected, atol=1e-5 * np.abs(expected).max())


def test_features_do_not_depend_on_the_other_images_of_a_batch(backbone):
    np.testing.assert_array_equal(backbone.maps(IMAGES), np.concatenate([backbone.maps(i[None]) for i in IMAGES]))


def test_an_export_that_answers_otherwise_is_refused(backbone, monkeypatch):
    def export(name, network, *_, **__):
        for name, value in network.layers.named_parameters():
            if name.endswith("bias"):
                value.zero_()
        return backbone.content

    monkeypatch.setattr(exporting, "export", export)
    with pytest.raises(VisionError, match="answers otherwise"):
        export_backbone(backbone.config, FeatureCache(None))


def test_a_network_is_exported_once(backbone, monkeypatch, tmp_path):
    cache = FeatureCache(tmp_path)
    monkeypatch.setattr(exporting, "export", lambda *_, **__: backbone.content)
    made = export_backbone(backbone.config, cache)
    monkeypatch.setattr(exporting, "export", lambda *_, **__: pytest.fail("exported again"))
    assert export_backbone(backbone.config, cache).fingerprint == made.fingerprint


# of a sound backbone: the configuration and content that are given instead, and the error
REFUSED = {
    "empty": (lambda its: (its.config, b""), "not an ONNX file"),
    "text": (lambda its: (its.config, b"no network"), "not an ONNX file"),
    "half a network": (lambda its: (its.config, its.content[: len(its.content) // 2]), "not an ONNX file"),
    "of other images": (
        lambda its: (replace(its.config, height=48), its.content),
        r"the input 'images' \(n, 48, 96, 3\)",
    ),
}


@pytest.mark.parametrize(("change", "match"), REFUSED.values(), ids=REFUSED)
def test_unusable_networks_are_refused(backbone, change, match):
    with pytest.raises(VisionError, match=match):
        Backbone(*change(backbone))
