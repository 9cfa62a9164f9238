"""Networks by name, in ONNX. The default ones come with the package: training with them needs no torch.

``scripts/networks.py`` wrote them from the weights in their packages, for images of any size; here they get the size of
a camera's images. ``shipped/LICENSES.md`` says whose they are. Others are exported from torch.
"""

from __future__ import annotations

import hashlib
from math import sqrt
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from conformodal.core.arrays import Float32Array
from conformodal.core.extras import require_extra
from conformodal.geometry import PinholeCamera

from .backbone import OUTPUT, Backbone, BackboneConfig
from .extract import FeatureCache
from .local import DETECTORS, HALFWAY_CELL, XFEAT_PARTS, XFEAT_STEP, Detector, XFeatDetector, pack_networks
from .settings import NETWORKS, VisionError, check_network

if TYPE_CHECKING:
    from onnx import ModelProto

_MAX_WIDTH = 320  # images are reduced to at most this width, and not enlarged
XFEAT_PIXELS = 448 * 320  # to which larger images are reduced for XFeat, see docs/decisions/landmarks.md
FOLDER = Path(__file__).parent / "shipped"
_DIGESTS = {
    "efficientnet_lite0": "c9e1c4ee00374081003fd967faba21163fd97fc298f35840400e03f227e05f90",
    "xfeat": "9fab32546c4a929a97f4d7b0a562387993491c3ed759af3b631ad322df694eff",
}
_MAP = "whole_map"  # of the layers, before it is averaged over the grid


def backbone_config(
    width: int, height: int, name: str = "efficientnet_lite0", *, whole: bool = False
) -> BackboneConfig:
    """The default features of a network for images of a size.

    `whole` gives those of a classifier, as in the paper: of the whole network, averaged over the image.
    """
    w = min(_MAX_WIDTH, width)
    size = (w, max(1, round(height * w / width)))
    return BackboneConfig(name, None, *size, grid=(1, 1)) if whole else BackboneConfig(name, default_block(name), *size)


def default_block(name: str) -> int:
    """The last block, or hidden state, with as many channels as the first at a sixteenth of the resolution."""
    check_network(name)
    if name in NETWORKS:
        return NETWORKS[name]
    with require_extra("networks", f"the network {name}"):
        from .torch_networks import hub_block  # noqa: PLC0415
    return hub_block(name)


def make_backbone(config: BackboneConfig, cache: FeatureCache) -> Backbone:
    """The network of a configuration; one that does not come with the package is exported, and the file cached."""
    if config.name in _DIGESTS and config.block == NETWORKS.get(config.name):
        return _shipped_backbone(config)
    with require_extra("networks", f"the network {config.name}"):
        from .export import export_backbone  # noqa: PLC0415 - torch takes a second to import
    return export_backbone(config, cache)


def make_detector(name: str, camera: PinholeCamera) -> Detector:
    """A detector of local features for images of a camera."""
    if name != XFeatDetector.name:
        return DETECTORS[name]()
    scale = min(1.0, sqrt(XFEAT_PIXELS / (camera.width * camera.height)))
    width, height = (max(1, round(scale * side / XFEAT_STEP)) * XFEAT_STEP for side in (camera.width, camera.height))
    halfway = (1, height // HALFWAY_CELL), (2, width // HALFWAY_CELL)
    return XFeatDetector(pack_networks(_divided(_sized(name, ((0, height), (1, width)), halfway))))


def _divided(network: ModelProto) -> dict[str, bytes]:
    """The parts of XFeat's network, each of which leads from one of its inputs to some of its outputs."""
    from onnx.utils import Extractor  # noqa: PLC0415 - only where a model is trained

    (image, halfway), (first, *features, logits) = network.graph.input, network.graph.output
    ends = ([image], [first]), ([halfway], features), ([image], [logits])
    names = [tuple([node.name for node in nodes] for nodes in each) for each in ends]
    parts = {part: Extractor(network).extract_model(*each) for part, each in zip(XFEAT_PARTS, names, strict=True)}
    return {part: bytes(network.SerializeToString()) for part, network in parts.items()}


def _shipped_backbone(config: BackboneConfig) -> Backbone:
    """The default layers, with the average over the grid."""
    model = _sized(config.name, ((1, config.height), (2, config.width)))
    with require_extra("train", "training"):
        from onnx import TensorProto, helper, numpy_helper, shape_inference  # noqa: PLC0415

    inferred = shape_inference.infer_shapes(model).graph.output[0].type.tensor_type.shape.dim
    n, channels, height, width = (side.dim_param or side.dim_value for side in inferred)
    rows, columns = config.grid
    for node in model.graph.node:
        node.output[:] = [_MAP if name == OUTPUT else name for name in node.output]
    matrices = {"rows": _averaging(height, rows), "columns": _averaging(width, columns).T}
    model.graph.initializer.extend(numpy_helper.from_array(matrix, name) for name, matrix in matrices.items())
    model.graph.node.extend(
        [
            helper.make_node("MatMul", [_MAP, "columns"], ["narrow_map"]),
            helper.make_node("MatMul", ["rows", "narrow_map"], ["grid"]),
            helper.make_node("Flatten", ["grid"], [OUTPUT], axis=1),
        ]
    )
    del model.graph.output[:]
    shape = [n, channels * rows * columns]
    model.graph.output.append(helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, shape))
    return Backbone(config, model.SerializeToString())


def _sized(name: str, *sides: tuple[tuple[int, int], ...]) -> ModelProto:
    """A network for images of one size; `sides` are axes of each of its inputs and their lengths."""
    with require_extra("train", "training"):
        import onnx  # noqa: PLC0415 - only where a model is trained

    content = (FOLDER / f"{name}.onnx").read_bytes()
    if hashlib.sha256(content).hexdigest() != _DIGESTS[name]:
        raise VisionError(f"{FOLDER / name}.onnx: is damaged; install conformodal again")
    model = onnx.load_from_string(content)
    for given, lengths in zip(model.graph.input, sides, strict=True):
        for axis, length in lengths:
            given.type.tensor_type.shape.dim[axis].dim_value = length
    del model.graph.value_info[:]
    for output in model.graph.output:  # ONNX Runtime infers it
        output.type.tensor_type.ClearField("shape")
    return model


def _averaging(n: int, parts: int) -> Float32Array:
    """The matrix (parts, n) that averages n numbers over parts; these overlap where n is no multiple of them."""
    starts, ends = (np.arange(parts) * n) // parts, -(-(np.arange(1, parts + 1) * n) // parts)
    inside = (np.arange(n) >= starts[:, None]) & (np.arange(n) < ends[:, None])
    return np.asarray(inside / inside.sum(axis=1, keepdims=True), dtype=np.float32)
