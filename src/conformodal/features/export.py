"""A network in ONNX, which runs without torch."""

from __future__ import annotations

import logging
import warnings

import numpy as np
import torch

from conformodal.core.extras import require_extra

from .backbone import INPUT, OUTPUT, Backbone, BackboneConfig
from .extract import FeatureCache
from .networks import Network
from .settings import VisionError

# What the oldest ONNX Runtime that is supported, 1.20, reads: IR 10 and opset 21. The exporter would write the newest.
OPSET, IR_VERSION = 18, 10
_TOLERANCE = 1e-3  # of the largest feature: rounding through some sixty layers; a wrong operator errs by far more


def make_backbone(config: BackboneConfig, cache: FeatureCache) -> Backbone:
    """A network exported to ONNX, cached; preprocessing is included and the batch size dynamic."""
    network = Network(config)
    cached = cache.load(network.digest, "networks")
    if cached is not None:
        return Backbone(config, cached.tobytes())
    backbone = Backbone(config, _export(network))
    _check_same(network, backbone)
    cache.store(network.digest, np.frombuffer(backbone.content, dtype=np.uint8), "networks")
    return backbone


def _export(network: Network) -> bytes:
    with require_extra("train", "the export of a network"):
        import onnxscript  # noqa: F401, PLC0415 - torch asks for it
    two = torch.zeros((2, network.config.height, network.config.width, 3), dtype=torch.uint8)
    logging.disable(logging.WARNING)  # advice on packages that are not needed
    try:
        with warnings.catch_warnings(action="ignore"):
            program = torch.onnx.export(
                network,
                (two,),
                dynamo=True,
                opset_version=OPSET,
                input_names=[INPUT],
                output_names=[OUTPUT],
                dynamic_shapes={"images": {0: torch.export.Dim("n")}},
                verbose=False,
            )
    except Exception as exc:  # whatever torch and onnxscript raise
        raise VisionError(f"{network.config.name} cannot be exported to ONNX: {exc}") from exc
    finally:
        logging.disable(logging.NOTSET)
    assert program is not None
    model = program.model_proto
    model.ir_version = IR_VERSION
    for part in (model, model.graph, *model.graph.node, *model.graph.value_info):
        del part.metadata_props[:]  # among them lines of source files of the machine that exports
    return bytes(model.SerializeToString())


def _check_same(network: Network, made: Backbone) -> None:
    shape = (2, network.config.height, network.config.width, 3)
    images = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    expected, maps = network.maps(images), made.maps(images)
    if expected.shape != maps.shape or np.abs(maps - expected).max() > _TOLERANCE * np.abs(expected).max():
        raise VisionError(f"{network.config.name} answers otherwise when exported to ONNX")
