import pytest

from conformodal.features.backbone import BackboneConfig
from conformodal.features.export import export_backbone
from conformodal.features.extract import FeatureCache
from conformodal.features.torch_networks import Network

CONFIG = BackboneConfig(width=96, height=64, grid=(2, 3))


@pytest.fixture(scope="session")
def network():
    return Network(CONFIG)


@pytest.fixture(scope="session")
def backbone():
    """The same network in ONNX."""
    return export_backbone(CONFIG, FeatureCache(None))
