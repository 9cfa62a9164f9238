import numpy as np
import onnxruntime
import pytest
from PIL import Image

from conformodal.localization.targets import TARGET_NAMES
from conformodal.networks import exporting
from conformodal.networks.exporting import exported, quantised, with_head
from conformodal.networks.heads import fit_head, soft_cross_entropy
from conformodal.networks.torch_backbone import TorchBackbone
from conformodal.vision.backbone import BackboneConfig, feature_views
from conformodal.vision.features import FeatureCache
from conformodal.vision.projection import fit_projection
from conformodal.vision.settings import TrainingConfig

CONFIG = BackboneConfig(width=96, height=64, grid=(2, 3))


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


@pytest.fixture(scope="module")
def onnx():
    return exported(TorchBackbone(CONFIG), FeatureCache(None))


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


@pytest.mark.parametrize("components", [4, None])
def test_the_file_with_the_head_gives_the_probabilities_of_the_model(onnx, images, components):
    features = onnx.describe(images).astype(np.float32)
    sizes = [3, 2, 4, 2, 3, 2, 5]
    labels = np.concatenate([np.random.default_rng(k).dirichlet(np.ones(k), len(images)) for k in sizes], axis=1)
    through = fit_projection(features, components, feature_views(features.shape[1]).network)
    config = TrainingConfig(epochs=3, hidden=16, batch_size=4)
    head = fit_head(features, labels, sizes, soft_cross_entropy, config, projection=through).trained()
    session = onnxruntime.InferenceSession(with_head(onnx, head, TARGET_NAMES), providers=["CPUExecutionProvider"])
    assert [node.name for node in session.get_outputs()] == ["map", *TARGET_NAMES]
    batch = session.run(list(TARGET_NAMES), {"images": images})  # of any number of images
    for k, expected in enumerate(head.predict_proba(features)):
        assert batch[k].shape == expected.shape
        single = np.concatenate([session.run([TARGET_NAMES[k]], {"images": image[None]})[0] for image in images])
        np.testing.assert_allclose(single, expected, atol=1e-5)
