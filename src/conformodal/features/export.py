"""Export of a network from torch to ONNX, in which it runs without torch."""

from __future__ import annotations

import logging
import warnings
from typing import Any

import numpy as np
import torch
from torch import nn

from conformodal.core.extras import require_extra

from .backbone import INPUT, OUTPUT, Backbone, BackboneConfig
from .extract import FeatureCache
from .settings import VisionError
from .torch_networks import Network

# What the oldest ONNX Runtime that is supported, 1.20, reads: IR 10 and opset 21. The exporter would write the newest.
OPSET, IR_VERSION = 18, 10
_TOLERANCE = 1e-3  # of the largest feature: rounding through some sixty layers; a wrong operator errs by far more


def export_backbone(config: BackboneConfig, cache: FeatureCache) -> Backbone:
    """A network exported to ONNX, cached; preprocessing is included and the batch size dynamic."""
    network = Network(config)
    cached = cache.load(network.digest, "networks")
    if cached is not None:
        return Backbone(config, cached.tobytes())
    two = torch.zeros((2, config.height, config.width, 3), dtype=torch.uint8)
    backbone = Backbone(config, export(config.name, network, {INPUT: two}, [OUTPUT], [{0: torch.export.Dim("n")}]))
    images = np.random.default_rng(0).integers(0, 256, two.shape, dtype=np.uint8)
    expected, made = network.maps(images), backbone.maps(images)
    if expected.shape != made.shape or np.abs(made - expected).max() > _TOLERANCE * np.abs(expected).max():
        raise VisionError(f"{config.name} answers otherwise when exported to ONNX")
    cache.store(network.digest, np.frombuffer(backbone.content, dtype=np.uint8), "networks")
    return backbone


def export(
    name: str, network: nn.Module, examples: dict[str, torch.Tensor], outputs: list[str], dynamic: list[dict[int, Any]]
) -> bytes:
    """A network in ONNX, from an example of each input.

    `dynamic` are the axes of each input whose length may vary, see :class:`torch.export.Dim`.
    """
    with require_extra("networks", "the export of a network"):
        import onnxscript  # noqa: F401, PLC0415 - torch asks for it
    logging.disable(logging.WARNING)  # advice on packages that are not needed
    try:
        with warnings.catch_warnings(action="ignore"):
            program = torch.onnx.export(
                network,
                tuple(examples.values()),
                dynamo=True,
                opset_version=OPSET,
                input_names=list(examples),
                output_names=outputs,
                dynamic_shapes=tuple(dynamic),
                verbose=False,
            )
    except Exception as exc:  # whatever torch and onnxscript raise
        raise VisionError(f"{name} cannot be exported to ONNX: {exc}") from exc
    finally:
        logging.disable(logging.NOTSET)
    assert program is not None
    model = program.model_proto
    model.ir_version = IR_VERSION
    for part in (model, model.graph, *model.graph.node, *model.graph.value_info):
        del part.metadata_props[:]  # among them lines of source files of the machine that exports
    return bytes(model.SerializeToString())
